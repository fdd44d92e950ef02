# SPDX-License-Identifier: Apache-2.0
"""Named training configurations of map models."""

from __future__ import annotations

import math
from dataclasses import replace

from manyeyes.models.maps.presets import get_map_model_config
from manyeyes.training.maps.losses import MapLossConfig
from manyeyes.training.maps.samples import MapAugmentConfig
from manyeyes.training.maps.task import MapTrainConfig

_NOISY = MapAugmentConfig(
    sigma_xy_m=0.2,
    sigma_yaw_rad=math.radians(0.3),
    bend_probability=0.4,
    max_curvature=1 / 40,
    curved_candidates=3,
)
_ONE_FRAME = replace(_NOISY, max_frames=1)
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
    loss=MapLossConfig(edge=5.0),
)

MAP_TRAINING_PRESETS: dict[str, MapTrainConfig] = {
    "map-tiny": MapTrainConfig(
        get_map_model_config("tiny"),
        steps=60,
        batch=2,
        learning_rate=2e-3,
        warmup_steps=10,
        save_every=20,
        augment=MapAugmentConfig(1, 3),
        loss=MapLossConfig(max_match_distance=math.inf),
        calibration_tiles=2,
    ),
    "map-small-lidar": _SMALL,
    "map-small-vehicle": replace(_SMALL, steps=600, line_field_steps=0, augment=replace(_ONE_FRAME, agents="vehicles")),
    "map-small-roadside": replace(
        _SMALL, steps=600, line_field_steps=0, augment=replace(_ONE_FRAME, agents="roadside-units")
    ),
    "map-small-camera": replace(
        _SMALL, map_model=get_map_model_config("small", ("camera",)), steps=1200, line_field_steps=300
    ),
    "map-small-fusion": replace(
        _SMALL,
        map_model=get_map_model_config("small", ("lidar", "camera")),
        steps=300,
        learning_rate=2e-3,
        warmup_steps=40,
        line_field_steps=0,
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
"""map-tiny: tests. map-small-lidar, map-small-camera, map-small-fusion: one to ten frames a tile, trainable on two CPU cores; the
two with cameras need images in the recording, and their steps suffice when initialised with trained weights (--weights).
map-small-vehicle, map-small-roadside: of one frame of one kind of agent (CrowdMap's Table 1), initialised with map-small-lidar.
map-paper: ten images a tile and batches of eight tiles as in the paper; steps and learning rate are those of MapTRv2.
"""
