# SPDX-License-Identifier: Apache-2.0
"""Encode one agent's sensors to ground features: a raster of its point cloud, its images, or both, on the same cells.

Cells that LiDAR and cameras both observe take the maximum of their features; other cells take those of one sensor. The masked
maximum is the same that later fuses agents (:func:`manyeyes.ops.bev_warp.masked_max`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, ImageSide, LayerCount
from manyeyes.datatypes import BevGrid, ConfigError, PointCloud
from manyeyes.datatypes.camera import CameraImage
from manyeyes.models.maps.image_encoder import (
    FeaturePyramid,
    ImageEncoder,
    ImageEncoderConfig,
    ResidualBlock,
    conv_norm,
)
from manyeyes.models.maps.view_transform import AgentCameras, DepthBins, lift_depth, lift_ground
from manyeyes.ops.voxelize import MOMENTS, pillar_moments, pillar_sites

Sensor = Literal["lidar", "camera"]
ViewTransform = Literal["depth", "ground"]

# Scales each of MOMENTS to about one: offsets within a pillar are decimetres, heights metres, asphalt's intensity is
# near 0.1.
_SCALE = (0.5, 4.0, 4.0, 1.0, 1.0, 0.5, 2.0, 8.0, 8.0, 40.0, 4.0, 3.0)


@dataclass(frozen=True)
class BevConfig:
    """Settings of the ground encoder.

    Attributes:
        grid: perception range in the agent's frame, and the pillars of the raster; tokens have twice its stride.
        sensors: sensors of the agent.
        channels: of the features.
        raster_channels: of the raster's first stage.
        raster_blocks: residual blocks per raster stage.
        image_encoder: settings of the image encoder.
        image_size: (height, width) to which images are resized, pixels.
        view_transform: method that lifts image features to the ground.
        max_pixel_footprint_m: maximum ground length that one pixel may cover, for ``ground``.
        heights_m: sampled heights above the road, for ``depth``.
        depth_bins: depths of the predicted distribution, for ``depth``.
    """

    grid: BevGrid
    sensors: tuple[Sensor, ...] = ("lidar",)
    channels: ChannelCount = 64
    raster_channels: ChannelCount = 32
    raster_blocks: tuple[LayerCount, ...] = (1, 2, 2)
    image_encoder: ImageEncoderConfig = field(default_factory=ImageEncoderConfig)
    image_size: tuple[ImageSide, ImageSide] = (224, 400)
    view_transform: ViewTransform = "depth"
    max_pixel_footprint_m: float = math.inf
    heights_m: tuple[float, ...] = (-0.5, 0.0, 0.5, 2.0)
    depth_bins: DepthBins = field(default_factory=DepthBins)

    def __post_init__(self) -> None:
        if not self.sensors or not set(self.sensors) <= {"lidar", "camera"}:
            raise ConfigError(f"BevConfig.sensors are some of lidar, camera; got {self.sensors}.")
        if self.grid.stride != 1:
            raise ConfigError(f"BevConfig.grid is given at stride 1; got {self.grid.stride}.")

    @property
    def token_grid(self) -> BevGrid:
        """The grid of the features."""
        return self.grid.at(2)


def rasterise_clouds(
    clouds: Sequence[PointCloud], grid: BevGrid, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Rasterise the clouds of N agents, each in its own frame; returns (N, 13, rows, columns) and occupancy (N, rows,
    columns).

    The channels are the twelve scaled moments of a pillar and its occupancy; empty pillars are zero. device: where the raster is
    made; None for that of the clouds.
    """
    cloud = PointCloud.cat(list(clouds))
    device = device or cloud.xyz.device
    xyz, intensity = cloud.xyz.to(device), cloud.intensity.to(device)
    batch = torch.cat([torch.full((len(c),), agent, device=device) for agent, c in enumerate(clouds)])
    pillars = pillar_sites(xyz, batch, grid, len(clouds))
    kept = pillars.inside
    moments = pillar_moments(xyz[kept], intensity[kept], pillars.row, pillars.sites)
    rows, columns = grid.shape
    raster = moments.new_zeros(len(clouds) * rows * columns, len(MOMENTS) + 1)
    raster[pillars.sites.key, :-1] = moments * moments.new_tensor(_SCALE)
    raster[pillars.sites.key, -1] = 1.0
    # channels_last makes convolutions on the CPU about 1.5 times as fast.
    raster = raster.view(len(clouds), rows, columns, -1).permute(0, 3, 1, 2)
    return raster, raster[:, -1] > 0


class _RasterEncoder(nn.Module):
    """A small residual network with a feature pyramid, from a ground raster (N, inputs, rows, columns) to the token
    grid.
    """

    def __init__(self, inputs: int, config: BevConfig) -> None:
        super().__init__()
        width = config.raster_channels
        widths = [width * 2**i for i in range(len(config.raster_blocks))]
        # Road markings are narrower than a token, so the stem keeps the full resolution.
        self.stem = nn.Sequential(conv_norm(inputs, width, 3), nn.ReLU())
        stages, inputs = [], width
        for count, outputs in zip(config.raster_blocks, widths):
            blocks = [ResidualBlock(inputs, outputs, 2)] + [ResidualBlock(outputs, outputs) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inputs = outputs
        self.stages = nn.ModuleList(stages)
        self.pyramid = FeaturePyramid(tuple(widths), config.channels)

    def encode(self, raster: Tensor) -> Tensor:
        """Encode a raster to features (N, channels, h, w)."""
        x, levels = self.stem(raster), []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return self.pyramid(levels)


class LidarBev(_RasterEncoder):
    """A 2.5-D raster of point clouds; a cell is observed where a return lies in it or beside it."""

    def __init__(self, config: BevConfig) -> None:
        super().__init__(len(MOMENTS) + 1, config)
        self.grid = config.grid

    def forward(self, clouds: Sequence[PointCloud]) -> tuple[Tensor, Tensor]:
        """Encode N clouds to features (N, C, h, w) on the token grid, and the observed mask (N, h, w)."""
        raster, hit = rasterise_clouds(clouds, self.grid, next(self.parameters()).device)
        return self.encode(raster), F.max_pool2d(hit[:, None].float(), 5, 2, 2)[:, 0] > 0


class CameraBev(_RasterEncoder):
    """Image features, lifted to a ground raster with the coordinates of its cells."""

    def __init__(self, config: BevConfig) -> None:
        super().__init__(config.raster_channels + 2, config)
        self.config = config
        self.encoder = ImageEncoder(config.image_encoder)
        bins = config.depth_bins.num_bins if config.view_transform == "depth" else 0
        self.project = nn.Conv2d(config.image_encoder.channels, config.raster_channels + bins, 1)

    def forward(self, images: Sequence[Sequence[CameraImage]]) -> tuple[Tensor, Tensor]:
        """Encode the images of N agents, any number each, to features (N, C, h, w) and the observed mask (N, h, w)."""
        config, grid = self.config, self.config.grid
        flat = [image for one in images for image in one]
        if not flat:
            shape = config.token_grid.shape
            nothing = self.project.weight.new_zeros(len(images), config.channels, *shape)
            return nothing, nothing[:, 0] > 0
        owners = [agent for agent, one in enumerate(images) for _ in one]
        owner = torch.tensor(owners, device=self.project.weight.device)
        height, width = config.image_size
        cameras = [image.camera.resize(width, height) for image in flat]
        rig = AgentCameras(cameras, owner, len(images))
        rgb = torch.cat([_resize(image.rgb, config.image_size) for image in flat]).to(owner.device)
        outputs = self.project(self.encoder(rgb.contiguous(memory_format=torch.channels_last)))
        features, stride = outputs[:, : config.raster_channels], config.image_encoder.stride
        if config.view_transform == "ground":
            raster, seen = lift_ground(features, rig, grid, stride, config.max_pixel_footprint_m)
        else:
            depth = outputs[:, config.raster_channels :].softmax(1)
            raster, seen = lift_depth(features, depth, rig, grid, stride, config.depth_bins, config.heights_m)
        # The image resolution of a cell depends on its position.
        rows, columns = grid.shape
        y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, device=raster.device) for n in (rows, columns)), indexing="ij")
        raster = torch.cat((raster, torch.stack((x, y)).expand(len(images), 2, rows, columns)), 1)
        near = F.max_pool2d(seen[:, None].float(), 3, 2, 1)[:, 0] > 0
        return self.encode(raster.contiguous(memory_format=torch.channels_last)), near


def _resize(rgb: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(rgb[None].float(), size, mode="bilinear", align_corners=False, antialias=True)
