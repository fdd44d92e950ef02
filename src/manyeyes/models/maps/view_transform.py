# SPDX-License-Identifier: Apache-2.0
"""Features of pictures to features of the ground: every cell of the ground asks the pictures what they saw of it.

Two ways with one signature. ``lift_ground`` takes the cell for a piece of a flat road and looks up its pixel (inverse
perspective mapping): no parameters, the plain twin. ``lift_depth`` asks at several heights and believes a pixel as far as it
holds the point's depth for likely: Lift-Splat-Shoot (Philion and Fidler, ECCV 2020) pulled instead of pushed, so that one
bilinear look-up replaces the scatter (specs: maps.md 1.4). Cells that several cameras see are their mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from manyeyes.datatypes import BevGrid, ConfigError, ShapeError, Transform
from manyeyes.datatypes.camera import Camera

MIN_DEPTH_M = 0.5
"""Nearer to a camera than this, nothing is looked up."""


@dataclass(frozen=True)
class DepthBins:
    """count depths in equal steps, the first near_m and the last far_m along the optical axis."""

    near_m: float = 1.0
    far_m: float = 49.0
    num_bins: int = 49

    def __post_init__(self) -> None:
        if not (0 < self.near_m < self.far_m and self.num_bins >= 2):
            raise ConfigError(f"DepthBins needs 0 < near_m < far_m and two bins or more; got {self}.")


@dataclass(frozen=True)
class _ProjectedCells:
    """Of V cameras, the cells of a grid that each sees, M at most: cell (V, M) int64, row by row; place (V, M, 2) in the features,
    as grid_sample counts; depth_m (V, M); valid (V, M): false where a camera sees fewer than M.
    """

    cell: Tensor
    place: Tensor
    depth_m: Tensor
    valid: Tensor


@dataclass(frozen=True)
class _LiftGeometry:
    """What a look-up depends on but the camera. features: their height and width; their cell o is centred on pixel stride * o."""

    grid: BevGrid
    height_m: float
    max_pixel_footprint_m: float
    features: tuple[int, int]
    stride: int


def _project_cells(cameras: Sequence[Camera], geometry: _LiftGeometry) -> _ProjectedCells:
    """Where cells of the ground, height_m above the road, lie in the features of each camera."""
    found = [_cells_in(_camera_key(camera), camera.width, camera.height, geometry) for camera in cameras]
    cells, places, depths = (pad_sequence(list(part), batch_first=True) for part in zip(*found))
    valid = torch.arange(cells.shape[1]) < torch.tensor([[len(one[0])] for one in found])
    return _ProjectedCells(cells, places, depths, valid)


def _camera_key(camera: Camera) -> tuple[float, ...]:
    pose = camera.agent_from_camera
    numbers = torch.cat((camera.intrinsic.flatten(), pose.rotation.flatten(), pose.translation))
    return tuple(numbers.double().tolist())


@lru_cache(maxsize=256)
def _cells_in(
    key: tuple[float, ...], width: int, height: int, geometry: _LiftGeometry
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells (M,), places (M, 2) and depths (M,) of one camera, kept: a rig looks the same way from look to look."""
    values = torch.tensor(key, dtype=torch.float64)
    camera = Camera(values[:9].view(3, 3), Transform(values[9:18].view(3, 3), values[18:]), width, height)
    rows, columns = geometry.grid.shape
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    xy = geometry.grid.centers(torch.stack((row, column), -1).view(-1, 2)).double()
    points = torch.cat((xy, torch.full((len(xy), 1), geometry.height_m, dtype=torch.float64)), 1)
    pixel, depth = camera.project(points)
    inside = (depth > MIN_DEPTH_M) & (pixel >= 0).all(-1) & (pixel[:, 0] <= width) & (pixel[:, 1] <= height)
    if geometry.max_pixel_footprint_m < math.inf:
        inside &= _pixel_footprint(camera, points) <= geometry.max_pixel_footprint_m
    cell = inside.nonzero()[:, 0]
    size = torch.tensor(geometry.features[::-1], dtype=torch.float64)
    return cell, ((2 * (pixel[cell] - 0.5) / geometry.stride + 1) / size - 1).float(), depth[cell].float()


def _pixel_footprint(camera: Camera, points: Tensor) -> Tensor:
    """(N,) metres of a level plane through each point (N, 3) that one pixel covers along the ray; vast above the camera."""
    offset = points - camera.agent_from_camera.translation
    return offset.square().sum(1) / (-offset[:, 2] * camera.intrinsic[1, 1]).clamp_min(1e-9)


def lift_ground(
    features: Tensor,
    cameras: Sequence[Camera],
    agent_of_camera: Tensor,
    num_agents: int,
    grid: BevGrid,
    stride: int,
    max_pixel_footprint_m: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Features (V, C, h, w) of V cameras to (agents, C, rows, columns), zero where unseen, and what is seen, bool.

    agent_of_camera: (V,) int64, whose camera it is. stride: pixels a feature, the first centred on the first pixel.
    max_pixel_footprint_m: ground of which one pixel covers more than this along its ray is unseen.
    """
    _check(features, cameras, agent_of_camera)
    projected = _project_cells(cameras, _LiftGeometry(grid, 0.0, max_pixel_footprint_m, _size(features), stride))
    return _average_cameras(
        [(projected, projected.valid, _sample(features, projected.place))], agent_of_camera, num_agents, grid
    )


def lift_depth(
    features: Tensor,
    depth: Tensor,
    cameras: Sequence[Camera],
    agent_of_camera: Tensor,
    num_agents: int,
    grid: BevGrid,
    stride: int,
    bins: DepthBins,
    heights_m: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """As :func:`lift_ground`, with depth (V, bins.count, h, w), a distribution a pixel, over heights above the road.

    A point takes its pixel's feature times the likelihood of the point's depth there, linear between bins; a cell is the sum over
    heights. Places beyond the bins are unseen.
    """
    _check(features, cameras, agent_of_camera)
    if depth.shape != (features.shape[0], bins.num_bins, *features.shape[-2:]):
        raise ShapeError(
            f"lift_depth needs depth (V, {bins.num_bins}, h, w) beside {tuple(features.shape)}; got {tuple(depth.shape)}."
        )
    found = []
    for height_m in heights_m:
        projected = _project_cells(cameras, _LiftGeometry(grid, height_m, math.inf, _size(features), stride))
        bin_at = (projected.depth_m - bins.near_m) / (bins.far_m - bins.near_m) * (bins.num_bins - 1)
        deep = torch.cat((projected.place, (2 * bin_at[..., None] + 1) / bins.num_bins - 1), -1)
        likelihood = _sample(depth[:, None], deep[:, None])
        within = projected.valid & (projected.depth_m >= bins.near_m) & (projected.depth_m <= bins.far_m)
        found.append((projected, within, _sample(features, projected.place) * likelihood))
    return _average_cameras(found, agent_of_camera, num_agents, grid)


def _size(features: Tensor) -> tuple[int, int]:
    return features.shape[-2], features.shape[-1]


def _sample(values: Tensor, place: Tensor) -> Tensor:
    """(V, M, C) of values (V, C, ...) at place (V, ..., M, coordinates), bilinear."""
    found = F.grid_sample(values, place[:, None], mode="bilinear", padding_mode="border", align_corners=False)
    return found.flatten(2).mT


def _average_cameras(
    found: Sequence[tuple[_ProjectedCells, Tensor, Tensor]], agent_of_camera: Tensor, num_agents: int, grid: BevGrid
) -> tuple[Tensor, Tensor]:
    """Sums of what was found, (V, M, C) where within (V, M), on the cells of agents, over the number of cameras that see a cell."""
    rows, columns = grid.shape
    cells, channels = rows * columns, found[0][2].shape[2]
    total = found[0][2].new_zeros(num_agents * cells, channels)
    visible = torch.zeros(len(agent_of_camera), cells, dtype=torch.bool)
    camera = torch.arange(len(agent_of_camera))[:, None]
    for projected, within, values in found:
        total = total.index_add(0, (agent_of_camera[:, None] * cells + projected.cell)[within], values[within])
        visible[camera.expand_as(within)[within], projected.cell[within]] = True
    count = (
        total.new_zeros(num_agents, cells)
        .index_add(0, agent_of_camera, visible.to(total.dtype))
        .view(num_agents, rows, columns)
    )
    mean = total.view(num_agents, rows, columns, channels) / count.clamp_min(1)[..., None]
    # Channels stay innermost in memory, as convolutions like them.
    return mean.permute(0, 3, 1, 2), count > 0


def _check(features: Tensor, cameras: Sequence[Camera], agent_of_camera: Tensor) -> None:
    if features.dim() != 4 or len(cameras) != features.shape[0] or agent_of_camera.shape != (len(cameras),):
        raise ShapeError(
            f"Lifting needs features (V, C, h, w) and an owner (V,) for each of {len(cameras)} cameras; got "
            f"{tuple(features.shape)} and {tuple(agent_of_camera.shape)}."
        )
