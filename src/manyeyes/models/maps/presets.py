# SPDX-License-Identifier: Apache-2.0
"""Named configurations of the map model."""

from __future__ import annotations

from dataclasses import replace

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.models.maps.bev import BevConfig, Sensor
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.image_encoder import ImageEncoderConfig
from manyeyes.models.maps.map_model import MapModelConfig
from manyeyes.models.maps.view_transform import DepthBins

FORMAT = "manyeyes-mapper-1"
"""Format name in the metadata of a map model's file."""


def _tile(cell_m: float) -> BevGrid:
    """CrowdMap's semi-global tile, 120 m along its road by 60 m."""
    return BevGrid(-60.0, -30.0, -5.0, 60.0, 30.0, 5.0, pillar=cell_m)


MAP_TINY = MapModelConfig(
    BevConfig(
        BevGrid(-36.0, -36.0, -2.0, 36.0, 36.0, 4.0, pillar=0.8),
        channels=32,
        raster_channels=12,
        raster_blocks=(1, 1),
        image_encoder=ImageEncoderConfig((1, 1), 12, channels=32),
        image_size=(64, 112),
        depth_bins=DepthBins(1.0, 37.0, 19),
    ),
    _tile(1.5),
    token_channels=16,
    head=MapHeadConfig(
        num_queries=80, num_points=10, num_learned_queries=60, channels=64, feedforward_channels=128, layers=2, heads=4
    ),
)
"""For tests and overfitting a few tiles, which learned queries do faster than queries from the line field."""

MAP_SMALL = MapModelConfig(
    BevConfig(
        BevGrid(-38.4, -38.4, -2.0, 38.4, 38.4, 4.0, pillar=0.4),
        channels=24,
        raster_channels=16,
        raster_blocks=(1, 1, 1),
        image_encoder=ImageEncoderConfig((1, 1, 1), 16, channels=24, stride=4),
        image_size=(136, 320),
        view_transform="ground",
        max_pixel_footprint_m=4.0,
    ),
    _tile(0.8),
    token_channels=24,
    neck_blocks=(1, 1, 1, 1),
    head=MapHeadConfig(num_queries=60, num_points=20, channels=64, feedforward_channels=128, layers=2, heads=4),
)
"""For two CPU cores: few layers per frame, because the fused tile is processed again."""

MAP_PAPER = MapModelConfig(
    BevConfig(
        BevGrid(-51.2, -51.2, -2.0, 51.2, 51.2, 4.0, pillar=0.4),
        channels=256,
        raster_channels=64,
        raster_blocks=(2, 2, 2),
        image_encoder=ImageEncoderConfig((3, 4, 6, 3), 64, True, 256, gradient_checkpointing=True),
        image_size=(480, 640),
        depth_bins=DepthBins(1.0, 69.0, 69),
    ),
    _tile(0.6),
    token_channels=128,
    neck_blocks=(2, 2, 2),
    head=MapHeadConfig(
        num_queries=100, num_points=20, num_one_to_many_queries=300, channels=256, feedforward_channels=512, layers=6
    ),
)
"""ResNet-50, 120 m by 60 m, 100 queries of 20 points (CrowdMap section 3.1), MapTRv2's decoder elsewhere. For GPUs."""

MAP_MODELS = {"tiny": MAP_TINY, "small": MAP_SMALL, "paper": MAP_PAPER}


def get_map_model_config(name: str, sensors: tuple[Sensor, ...] = ("lidar",)) -> MapModelConfig:
    """Return a preset of MAP_MODELS for agents with these sensors."""
    if name not in MAP_MODELS:
        raise ConfigError(f"No map model is called {name!r}; choose one of {', '.join(MAP_MODELS)}.")
    config = MAP_MODELS[name]
    return replace(config, bev=replace(config.bev, sensors=sensors))
