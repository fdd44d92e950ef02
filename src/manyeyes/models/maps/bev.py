# SPDX-License-Identifier: Apache-2.0
"""One agent's sensors to features of the ground around it: a raster of its cloud, its pictures, or both, on the same cells.

A sensor is one more eye: cells that LiDAR and cameras both see are their maximum, those that one sees are that one's, by the
same masked maximum that later joins agents (:func:`manyeyes.ops.bev_warp.masked_max`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, ConfigError, PointCloud
from manyeyes.datatypes.camera import CameraImage
from manyeyes.models.maps.image_encoder import ImageEncoder, ImageEncoderConfig, Pyramid, Residual, conv
from manyeyes.models.maps.view_transform import DepthBins, lift_depth, lift_ground
from manyeyes.ops.voxelize import MOMENTS, pillar_moments, pillar_sites

Sensor = Literal["lidar", "camera"]
Lift = Literal["depth", "ground"]

# Brings each of MOMENTS to about one: offsets within a pillar are decimetres, heights metres, asphalt's intensity is near 0.1.
_SCALE = (0.5, 4.0, 4.0, 1.0, 1.0, 0.5, 2.0, 8.0, 8.0, 40.0, 4.0, 3.0)


@dataclass(frozen=True)
class BevConfig:
    """grid: what an agent sees, metres in its frame, and the pillars of the raster; its tokens lie at twice its stride.

    sensors: which it has. channels: of the features; raster_width: of the raster's first stage. image: the encoder of pictures,
    which are first brought to image_size, (height, width) pixels. lift: how pictures reach the ground; coarsest_m: of ``ground``
    alone, how much of the ground one pixel may cover; heights_m and depth: of ``depth`` alone.
    """

    grid: BevGrid
    sensors: tuple[Sensor, ...] = ("lidar",)
    channels: int = 64
    raster_width: int = 32
    raster_blocks: tuple[int, ...] = (1, 2, 2)
    image: ImageEncoderConfig = field(default_factory=ImageEncoderConfig)
    image_size: tuple[int, int] = (224, 400)
    lift: Lift = "depth"
    coarsest_m: float = math.inf
    heights_m: tuple[float, ...] = (-0.5, 0.0, 0.5, 2.0)
    depth: DepthBins = field(default_factory=DepthBins)

    def __post_init__(self) -> None:
        if not self.sensors or not set(self.sensors) <= {"lidar", "camera"}:
            raise ConfigError(f"BevConfig.sensors are some of lidar, camera; got {self.sensors}.")
        if self.grid.stride != 1:
            raise ConfigError(f"BevConfig.grid is given at stride 1; got {self.grid.stride}.")

    @property
    def token_grid(self) -> BevGrid:
        """The lattice of the features."""
        return self.grid.at(2)


def rasterise(clouds: Sequence[PointCloud], grid: BevGrid) -> tuple[Tensor, Tensor]:
    """Clouds of N agents, each in its own frame, as (N, 13, rows, columns), and which cells (N, rows, columns) hold a return.

    The channels are the twelve moments of a pillar, brought to about one, and whether there is any; zero elsewhere.
    """
    cloud = PointCloud.cat(list(clouds))
    batch = torch.repeat_interleave(torch.arange(len(clouds)), torch.tensor([len(c) for c in clouds]))
    pillars = pillar_sites(cloud.xyz, batch, grid, len(clouds))
    kept = pillars.inside
    moments = pillar_moments(cloud.xyz[kept], cloud.intensity[kept], pillars.row, pillars.sites)
    rows, columns = grid.shape
    raster = torch.zeros(len(clouds) * rows * columns, len(MOMENTS) + 1)
    raster[pillars.sites.key, :-1] = moments * torch.tensor(_SCALE)
    raster[pillars.sites.key, -1] = 1.0
    # Channels stay innermost in memory (channels_last), in which convolutions run half again as fast on a processor.
    raster = raster.view(len(clouds), rows, columns, -1).permute(0, 3, 1, 2)
    return raster, raster[:, -1] > 0


class _GroundNet(nn.Module):
    """A raster of the ground (N, inputs, rows, columns) through a small residual network and a pyramid, to the token grid."""

    def __init__(self, inputs: int, config: BevConfig) -> None:
        super().__init__()
        width = config.raster_width
        widths = [width * 2**i for i in range(len(config.raster_blocks))]
        # Paint is narrower than a token: what is fine is read before it is made coarse.
        self.stem = nn.Sequential(conv(inputs, width, 3), nn.ReLU())
        stages, inputs = [], width
        for count, outputs in zip(config.raster_blocks, widths):
            blocks = [Residual(inputs, outputs, 2)] + [Residual(outputs, outputs) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inputs = outputs
        self.stages = nn.ModuleList(stages)
        self.pyramid = Pyramid(tuple(widths), config.channels)

    def read(self, raster: Tensor) -> Tensor:
        """(N, channels, h, w)."""
        x, levels = self.stem(raster), []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return self.pyramid(levels)


class LidarBev(_GroundNet):
    """A 2.5-D raster of clouds; a cell is seen where a return lies in or beside it."""

    def __init__(self, config: BevConfig) -> None:
        super().__init__(len(MOMENTS) + 1, config)
        self.grid = config.grid

    def forward(self, clouds: Sequence[PointCloud]) -> tuple[Tensor, Tensor]:
        """N clouds to features (N, C, h, w) on the token grid and what is seen (N, h, w)."""
        raster, hit = rasterise(clouds, self.grid)
        return self.read(raster), F.max_pool2d(hit[:, None].float(), 5, 2, 2)[:, 0] > 0


class CameraBev(_GroundNet):
    """Pictures through the image encoder, lifted to a raster of the ground beside where each of its cells lies."""

    def __init__(self, config: BevConfig) -> None:
        super().__init__(config.raster_width + 2, config)
        self.config = config
        self.encoder = ImageEncoder(config.image)
        bins = config.depth.count if config.lift == "depth" else 0
        self.project = nn.Conv2d(config.image.channels, config.raster_width + bins, 1)

    def forward(self, images: Sequence[Sequence[CameraImage]]) -> tuple[Tensor, Tensor]:
        """The pictures of N agents, any number each, to features (N, C, h, w) on the token grid and what is seen (N, h, w)."""
        config, grid = self.config, self.config.grid
        flat = [image for one in images for image in one]
        if not flat:
            shape = config.token_grid.shape
            return torch.zeros(len(images), config.channels, *shape), torch.zeros(len(images), *shape, dtype=torch.bool)
        owner = torch.repeat_interleave(torch.arange(len(images)), torch.tensor([len(one) for one in images]))
        height, width = config.image_size
        cameras = [image.camera.resized(width, height) for image in flat]
        rgb = torch.cat([_resized(image.rgb, config.image_size) for image in flat])
        told = self.project(self.encoder(rgb.contiguous(memory_format=torch.channels_last)))
        features, stride = told[:, : config.raster_width], config.image.stride
        if config.lift == "ground":
            raster, seen = lift_ground(features, cameras, owner, len(images), grid, stride, config.coarsest_m)
        else:
            depth = told[:, config.raster_width :].softmax(1)
            raster, seen = lift_depth(
                features, depth, cameras, owner, len(images), grid, stride, config.depth, config.heights_m
            )
        # How sharply a cell is seen depends on where it lies.
        rows, columns = grid.shape
        y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        raster = torch.cat((raster, torch.stack((x, y)).expand(len(images), 2, rows, columns)), 1)
        near = F.max_pool2d(seen[:, None].float(), 3, 2, 1)[:, 0] > 0
        return self.read(raster.contiguous(memory_format=torch.channels_last)), near


def _resized(rgb: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(rgb[None].float(), size, mode="bilinear", align_corners=False, antialias=True)
