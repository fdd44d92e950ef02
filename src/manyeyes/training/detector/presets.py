# SPDX-License-Identifier: Apache-2.0
"""Named training configurations of the detector."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from manyeyes.models.detector.presets import COSTR_OPV2V, COSTR_SMALL, COSTR_TINY, SMALL_GRID, SMALL_SQUARE_GRID
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig
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
_BRANCH = replace(
    _FINAL,
    degradation=replace(_FINAL.degradation, sender_history=2),
    steps=240,
    learning_rate=3e-4,
    warmup_steps=20,
    prune_warmup_end=0.001,
)


def _branch(**changes: Any) -> DetectorTrainConfig:
    """Return one row of CoSTr's Table III: the final stage trained on, with a part of the model changed."""
    return replace(_BRANCH, detector=replace(_BRANCH.detector, **changes))


_FINE_ONLY = replace(COSTR_SMALL.encoder, use_coarse_strides=False, prune_strides=())
_NO_BLOCKS = replace(COSTR_SMALL.dast, blocks=0)
_PLAIN = {"dast": _NO_BLOCKS, "fusion": "max"}

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
    "costr-small/stage3": _DEGRADED,
    "costr-small/stage4": _FINAL,
    "ablation/none": _branch(**_PLAIN, encoder=_FINE_ONLY),
    "ablation/se": _branch(**_PLAIN),
    "ablation/se-dast": _branch(fusion="max"),
    "ablation/se-dast-self-attention": _branch(fusion="self-attention"),
    "ablation/se-fast": _branch(dast=_NO_BLOCKS),
    "ablation/se-dast-fast": _BRANCH,
    "ablation/v2x-vit": _branch(fusion="v2x-vit"),
    "ablation/multi-scale": _branch(fusion="multi-scale"),
    "costr-opv2v": DetectorTrainConfig(COSTR_OPV2V, epochs=90.0, batch=4, learning_rate=2e-4),
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
"""costr-small/stage1 to stage4, each initialised with the weights of the stage before, give the shipped weights: stage2 adds the
wider range, all agents and the IoU loss; stage3 adds history, delay, pose errors, packet loss and budgets; stage4 prunes more
cells, object by object. ablation/*: rows of the ablation, each trained on from the shipped weights for the same number of steps.
costr-opv2v: 80 + 10 epochs as in the paper. costr-tiny: tests and examples.
"""
