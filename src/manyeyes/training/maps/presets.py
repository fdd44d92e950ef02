# SPDX-License-Identifier: Apache-2.0
"""Training settings of map models by name."""

from __future__ import annotations

import math
from dataclasses import replace

from manyeyes.models.maps.presets import get_map_model_config
from manyeyes.training.maps.loop import MapTrainConfig
from manyeyes.training.maps.losses import MapLossConfig
from manyeyes.training.maps.samples import MapAugmentConfig

_NOISY = MapAugmentConfig(sigma_xy_m=0.2, sigma_yaw_rad=math.radians(0.3))
_SMALL = MapTrainConfig(
    get_map_model_config("small"),
    steps=2000,
    batch=4,
    learning_rate=3e-3,
    save_every=50,
    ema_decay=0.99,
    max_token_dropout=0.5,
    line_field_steps=700,
    calibration_tiles=64,
    augment=_NOISY,
)

MAP_TRAINING_PRESETS: dict[str, MapTrainConfig] = {
    "map-toy": MapTrainConfig(
        get_map_model_config("toy"),
        steps=60,
        batch=2,
        learning_rate=2e-3,
        warmup_steps=10,
        save_every=20,
        augment=MapAugmentConfig(1, 3),
        loss=MapLossConfig(max_match_distance=math.inf),
        calibration_tiles=2,
    ),
    "map-small": _SMALL,
    "map-small-camera": replace(
        _SMALL, map_model=get_map_model_config("small", ("camera",)), steps=1200, line_field_steps=300
    ),
    "map-small-both": replace(
        _SMALL,
        map_model=get_map_model_config("small", ("lidar", "camera")),
        steps=300,
        learning_rate=2e-3,
        warm_up=40,
        sketch_steps=0,
    ),
    "map-paper": MapTrainConfig(
        get_map_model_config("paper", ("camera",)),
        steps=60000,
        batch=8,
        learning_rate=6e-4,
        warmup_steps=500,
        save_every=500,
        calibration_tiles=64,
        micro_batch=1,
        augment=MapAugmentConfig(min_frames=10),
        loss=MapLossConfig(one_to_many_repeats=6),
    ),
}
"""map-toy: tests. map-small: one to ten looks a tile, two cores; its two siblings need pictures in the recording, and their steps
are enough where a run begins from weights (the verb's --weights) that know tiles already. map-paper: the
paper's ten pictures a tile and batch of eight; steps and rate are MapTRv2's, the paper gives none."""
