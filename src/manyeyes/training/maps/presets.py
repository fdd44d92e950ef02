# SPDX-License-Identifier: Apache-2.0
"""Training settings of map models by name."""

from __future__ import annotations

import math
from dataclasses import replace

from manyeyes.models.maps.presets import mapper_config
from manyeyes.training.maps.loop import MapTrainConfig
from manyeyes.training.maps.losses import MapLossConfig
from manyeyes.training.maps.samples import MapAugment

_NOISY = MapAugment(sigma_m=0.2, sigma_rad=math.radians(0.3))
_SMALL = MapTrainConfig(
    mapper_config("small"),
    steps=2000,
    batch=4,
    learning_rate=3e-3,
    save_every=50,
    ema=0.99,
    thin=0.5,
    sketch_steps=700,
    calibrated=64,
    augment=_NOISY,
)

MAP_TRAINING: dict[str, MapTrainConfig] = {
    "map-toy": MapTrainConfig(
        mapper_config("toy"),
        steps=60,
        batch=2,
        learning_rate=2e-3,
        warm_up=10,
        save_every=20,
        augment=MapAugment(1, 3),
        loss=MapLossConfig(far=math.inf),
        calibrated=2,
    ),
    "map-small": _SMALL,
    "map-small-camera": replace(_SMALL, mapper=mapper_config("small", ("camera",)), steps=1200, sketch_steps=300),
    "map-small-both": replace(
        _SMALL,
        mapper=mapper_config("small", ("lidar", "camera")),
        steps=300,
        learning_rate=2e-3,
        warm_up=40,
        sketch_steps=0,
    ),
    "map-paper": MapTrainConfig(
        mapper_config("paper", ("camera",)),
        steps=60000,
        batch=8,
        learning_rate=6e-4,
        warm_up=500,
        save_every=500,
        calibrated=64,
        at_once=1,
        augment=MapAugment(least=10),
        loss=MapLossConfig(repeat=6),
    ),
}
"""map-toy: tests. map-small: one to ten looks a tile, two cores; its two siblings need pictures in the recording, and their steps
are enough where a run begins from weights (the verb's --weights) that know tiles already. map-paper: the
paper's ten pictures a tile and batch of eight; steps and rate are MapTRv2's, the paper gives none."""
