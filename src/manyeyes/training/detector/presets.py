# SPDX-License-Identifier: Apache-2.0
"""Named training configurations of the detector."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from manyeyes.datatypes import BevGrid
from manyeyes.models.detector.presets import (
    BASE_SQUARE_GRID,
    COSTR_BASE,
    COSTR_DAIR,
    COSTR_OPV2V,
    COSTR_SMALL,
    COSTR_TINY,
    COSTR_V2X_REAL,
    COSTR_V2XSET,
    SMALL_GRID,
    SMALL_SQUARE_GRID,
)
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig
from manyeyes.training.detector.sensor_augmentation import SensorAugmentConfig
from manyeyes.training.detector.task import DetectorTrainConfig

_DEGRADED = DetectorTrainConfig(
    replace(COSTR_SMALL, grid=SMALL_SQUARE_GRID, output_range=SMALL_GRID, prune_threshold=0.08),
    steps=5200,
    batch=4,
    learning_rate=1e-3,
    warmup_steps=100,
    save_every=100,
    prune_warmup_start=0.0,
    prune_warmup_end=0.02,
    augment=AugmentConfig(max_point_dropout=0.1),
    degradation=DegradationConfig(
        ego_history=2, delay_prob=0.4, pose_noise_prob=0.5, packet_loss_prob=0.25, budget_prob=0.4
    ),
    loss=LossConfig(iou=0.5, fusion_weight=0.6),
)
_FINAL = replace(
    _DEGRADED,
    detector=replace(_DEGRADED.detector, prune_threshold=0.12),
    steps=3400,
    augment=AugmentConfig(max_point_dropout=0.1, early_fusion_prob=0.2),
    loss=LossConfig(iou=0.8, fusion_weight=0.6, prune=1.0),
)
_MIXTURE = SensorAugmentConfig()


def _mix_sensors(config: DetectorTrainConfig) -> DetectorTrainConfig:
    """Return a stage whose samples have drawn sensors and intensity laws."""
    return replace(config, augment=replace(config.augment, sensors=_MIXTURE))


def _widen(config: DetectorTrainConfig, **changes: Any) -> DetectorTrainConfig:
    """Return a stage at the range of costr-base, for weights that are trained at that of costr-small."""
    grids = {"grid": BASE_SQUARE_GRID, "output_range": COSTR_BASE.grid}
    return replace(config, detector=replace(config.detector, **grids), prune_warmup_end=0.001, **changes)


_PUBLISHED = DetectorTrainConfig(COSTR_OPV2V, epochs=90.0, batch=4, learning_rate=2e-4)
"""CoSTr, section IV: 80 + 10 epochs at a learning rate of 2e-4; warm-up over 500 steps and a cosine to zero are ours."""

DETECTOR_TRAINING_PRESETS: dict[str, DetectorTrainConfig] = {
    "costr-small/stage1": DetectorTrainConfig(
        COSTR_SMALL,
        steps=9000,
        batch=4,
        learning_rate=1.5e-3,
        warmup_steps=200,
        save_every=100,
        prune_warmup_start=0.02,
        prune_warmup_end=0.10,
    ),
    "costr-small/stage2": DetectorTrainConfig(
        replace(COSTR_SMALL, grid=SMALL_SQUARE_GRID, output_range=SMALL_GRID, prune_threshold=0.08),
        steps=3000,
        batch=4,
        learning_rate=5e-4,
        warmup_steps=50,
        save_every=100,
        prune_warmup_start=0.0,
        prune_warmup_end=0.001,
        augment=AugmentConfig(max_agents=99),
        loss=LossConfig(iou=0.5),
    ),
    "costr-small/stage3": _mix_sensors(_DEGRADED),
    "costr-small/stage4": _mix_sensors(_FINAL),
    "costr-small/stage5": _widen(_mix_sensors(_DEGRADED), steps=3000, learning_rate=6e-4),
    "costr-small/stage6": _widen(_mix_sensors(_FINAL), steps=4000, learning_rate=6e-4),
    "costr-small/stage7": _widen(_mix_sensors(_FINAL), steps=1500, batch=16, learning_rate=6e-4),
    "costr-opv2v": _PUBLISHED,
    "costr-v2xset": replace(_PUBLISHED, detector=COSTR_V2XSET),
    "costr-dair": replace(_PUBLISHED, detector=COSTR_DAIR),
    "costr-v2x-real": replace(_PUBLISHED, detector=COSTR_V2X_REAL),
    "costr-tiny": DetectorTrainConfig(
        COSTR_TINY,
        steps=60,
        batch=2,
        learning_rate=3e-3,
        warmup_steps=5,
        save_every=20,
        augment=AugmentConfig(max_agents=3),
    ),
}
"""costr-small/stage1 to stage4, each initialised with the weights of the stage before: stage2 adds the wider range, all
agents and the IoU loss; stage3 adds history, delay, pose errors, packet loss, budgets, and drawn sensors and intensity laws;
stage4 prunes more cells, object by object; stage5 and stage6 repeat both at twice the range; stage7 repeats stage6 with
larger batches. costr-opv2v, costr-v2xset, costr-dair and costr-v2x-real: the published data sets, 80 + 10 epochs as in the
paper. costr-tiny: tests and examples.
"""


def _stages(prefix: str, *names: str) -> tuple[tuple[str, DetectorTrainConfig], ...]:
    return tuple((name, DETECTOR_TRAINING_PRESETS[f"{prefix}/{name}"]) for name in names)


_STAGES = _stages("costr-small", *(f"stage{number}" for number in range(1, 8)))
_RELEASED = replace(
    _FINAL.detector, prune_threshold=0.1, min_sent_score=0.05, decode=replace(COSTR_SMALL.decode, iou_score_weight=0.7)
)
_SMALL_RELEASED = replace(_RELEASED, grid=BevGrid(-102.4, -102.4, -5.0, 102.4, 102.4, 6.0))
_BASE_RELEASED = replace(_RELEASED, grid=BASE_SQUARE_GRID, output_range=COSTR_BASE.grid)

DETECTOR_PLANS: dict[str, TrainPlan] = {
    "costr-small": TrainPlan(_STAGES[:6], released=_SMALL_RELEASED),
    "costr-base": TrainPlan(_STAGES, released=_BASE_RELEASED),
    "costr-tiny/plan": TrainPlan(
        tuple((f"stage{k}", DETECTOR_TRAINING_PRESETS["costr-tiny"]) for k in (1, 2)), codebook_frames=4
    ),
}
"""From nothing to weights with a codebook. costr-small: six stages, costr-base: the same and a seventh; each is released at its
range, with a codebook and a calibration of its own. costr-tiny/plan: tests.
"""
