# SPDX-License-Identifier: Apache-2.0
"""Training settings by name."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.models.presets import COSTR_OPV2V, COSTR_SMALL, COSTR_TINY, SMALL_AROUND, SMALL_GRID
from manyeyes.training.loop import TrainConfig
from manyeyes.training.losses import LossConfig
from manyeyes.training.samples import AugmentConfig, RoadConfig

TRAINING_PRESETS: dict[str, TrainConfig] = {
    "costr-small": TrainConfig(
        COSTR_SMALL,
        steps=9000,
        batch=4,
        learning_rate=1.5e-3,
        warm_up=200,
        save_every=100,
        prune_from=0.02,
        prune_full=0.10,
    ),
    "costr-small-2": TrainConfig(
        replace(COSTR_SMALL, grid=SMALL_AROUND, answers=SMALL_GRID, prune_threshold=0.08),
        steps=3000,
        batch=4,
        learning_rate=5e-4,
        warm_up=50,
        save_every=100,
        prune_from=0.0,
        prune_full=0.001,
        augment=AugmentConfig(max_agents=99),
        loss=LossConfig(iou=0.5),
    ),
    "costr-small-3": TrainConfig(
        replace(COSTR_SMALL, grid=SMALL_AROUND, answers=SMALL_GRID, prune_threshold=0.08),
        steps=5200,
        batch=4,
        learning_rate=1e-3,
        warm_up=100,
        save_every=100,
        prune_from=0.0,
        prune_full=0.02,
        augment=AugmentConfig(thin=0.1),
        road=RoadConfig(past=2, late_share=0.4, astray_share=0.5, lost_share=0.25, few_share=0.4),
        loss=LossConfig(iou=0.5, together=0.6),
    ),
    "costr-opv2v": TrainConfig(COSTR_OPV2V, epochs=90.0, batch=4, learning_rate=2e-4),
    "costr-tiny": TrainConfig(
        COSTR_TINY, steps=60, batch=2, learning_rate=3e-3, warm_up=5, save_every=20, augment=AugmentConfig(max_agents=3)
    ),
}
"""costr-small and then, from its weights, costr-small-2 (what lies to the sides is seen as well, all agents at once, IoU itself in
the loss): what ships. costr-opv2v: the paper's 80 + 10 epochs. costr-tiny: tests and examples."""
