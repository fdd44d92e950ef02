# SPDX-License-Identifier: Apache-2.0
"""Plans that train finished weights on over a few labelled frames of one's own sensor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.box_head import check_classes
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import DetectorConfig
from manyeyes.training.detector.losses import LossConfig
from manyeyes.training.detector.plan import TrainPlan
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig
from manyeyes.training.detector.task import DetectorTrainConfig

STAGE = "finetune"
MIN_STEPS, MAX_STEPS = 120, 1500
"""Bounds of the default number of steps: of 20 frames and fewer, and of 500 and more."""
BATCH = 3
LEARNING_RATE = 5e-4
CodebookChoice = Literal["refit", "keep"]


def choose_steps(num_frames: int) -> int:
    """Return the default number of optimiser steps for a number of labelled frames.

    It grows with the square root of the frames from MIN_STEPS: about 18 passes over 20 frames at BATCH samples a step, and 4 over
    500 frames, rounded to tens.
    """
    steps = MIN_STEPS * math.sqrt(max(1, num_frames) / 20)
    return int(10 * round(min(MAX_STEPS, max(MIN_STEPS, steps)) / 10))


def make_finetune_plan(
    detector: DetectorConfig,
    steps: int,
    learning_rate: float = LEARNING_RATE,
    codebook: CodebookChoice = "refit",
    classes: tuple[str, ...] | None = None,
) -> TrainPlan:
    """Make the plan of one stage that trains weights of a configuration on.

    Intensity stays as recorded. Frames are turned and mirrored, agents left out and delayed, as in the last stage of training.

    Args:
        detector: configuration of the weights.
        steps: of the optimiser.
        learning_rate: its peak.
        codebook: refit: to the new tokens; keep: that of the weights. Weights without one get one.
        classes: of objects that the result detects; by default those of the weights.

    Raises:
        ConfigError: a class is unknown, or the result would lack one of the weights.
    """
    wanted = check_classes(classes or detector.classes)
    lacking = [name for name in detector.classes if name not in wanted]
    if lacking:
        raise ConfigError(
            f"The weights detect {', '.join(lacking)}, too; name {'it' if len(lacking) == 1 else 'them'} among the classes."
        )
    detector = replace(detector, classes=wanted)
    config = DetectorTrainConfig(
        replace(detector, codebook=None),
        steps=steps,
        batch=BATCH,
        learning_rate=learning_rate,
        warmup_steps=max(1, steps // 8),
        ema_decay=0.99,
        save_every=20,
        prune_warmup_start=0.0,
        prune_warmup_end=0.001,
        augment=AugmentConfig(max_point_dropout=0.1, early_fusion_prob=0.2),
        degradation=DegradationConfig(
            ego_history=1, delay_prob=0.3, pose_noise_prob=0.3, packet_loss_prob=0.2, budget_prob=0.3
        ),
        loss=LossConfig(iou=0.8, fusion_weight=0.6, prune=1.0),
    )
    keeps = codebook == "keep" and detector.codebook is not None
    fitted = detector.codebook or CodebookConfig()
    return TrainPlan(((STAGE, config),), released=detector, codebook="start" if keeps else fitted)
