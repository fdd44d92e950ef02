# SPDX-License-Identifier: Apache-2.0
"""Transform image features to ground features: every ground cell samples the images that observe it.

Two methods share one signature. ``lift_ground`` projects the cell as a piece of flat road (inverse perspective mapping), without
parameters. ``lift_depth`` projects points at several heights and weights each by the predicted likelihood of its depth:
Lift-Splat-Shoot (Philion and Fidler, ECCV 2020) as a gather, so that one bilinear sampling replaces the scatter. Cells observed by
several cameras are averaged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from manyeyes.datatypes import BevGrid, ConfigError, ShapeError, Transform
from manyeyes.datatypes.camera import Camera

MIN_DEPTH_M = 0.5
"""Minimum depth of a projected point."""


@dataclass(frozen=True)
class DepthBins:
    """num_bins depths at equal steps from near_m to far_m along the optical axis."""

    near_m: float = 1.0
    far_m: float = 49.0
    num_bins: int = 49

    def __post_init__(self) -> None:
        if not (0 < self.near_m < self.far_m and self.num_bins >= 2):
            raise ConfigError(f"DepthBins needs 0 < near_m < far_m and two bins or more; got {self}.")


class AgentCameras(NamedTuple):
    """V cameras of several agents, and the agent of each camera (V,) int64."""

    cameras: Sequence[Camera]
    agent_of_camera: Tensor
    num_agents: int


@dataclass(frozen=True)
class _ProjectedCells:
    """Ground cells that V cameras observe, padded to M per camera.

    cell: (V, M) int64, row-major. place: (V, M, 2) in the features, grid_sample coordinates. depth_m: (V, M). valid:
    (V, M), false for
    padding.
    """

    cell: Tensor
    place: Tensor
    depth_m: Tensor
    valid: Tensor


@dataclass(frozen=True)
class _LiftGeometry:
    """Parameters of a projection beside the camera; features: (height, width), feature o is centred on pixel stride *
    o.
    """

    grid: BevGrid
    height_m: float
    max_pixel_footprint_m: float
    features: tuple[int, int]
    stride: int


def _project_cells(cameras: Sequence[Camera], geometry: _LiftGeometry, device: torch.device) -> _ProjectedCells:
    """Project ground cells at height_m above the road to the features of each camera."""
    found = [_cells_in(_camera_key(camera), camera.width, camera.height, geometry) for camera in cameras]
    cells, places, depths = (pad_sequence(list(part), batch_first=True) for part in zip(*found))
    counts = torch.tensor([[len(one[0])] for one in found], device="cpu")
    valid = torch.arange(cells.shape[1], device="cpu") < counts
    return _ProjectedCells(*(part.to(device) for part in (cells, places, depths, valid)))


def _camera_key(camera: Camera) -> tuple[float, ...]:
    pose = camera.agent_from_camera
    numbers = torch.cat((camera.intrinsic.flatten(), pose.rotation.flatten(), pose.translation))
    return tuple(numbers.double().tolist())


@lru_cache(maxsize=256)
def _cells_in(
    key: tuple[float, ...], width: int, height: int, geometry: _LiftGeometry
) -> tuple[Tensor, Tensor, Tensor]:
    """Return cells (M,), places (M, 2) and depths (M,) of one camera, cached, as the rig is constant over frames."""
    values = torch.tensor(key, dtype=torch.float64, device="cpu")
    camera = Camera(values[:9].view(3, 3), Transform(values[9:18].view(3, 3), values[18:]), width, height)
    rows, columns = geometry.grid.shape
    row, column = torch.meshgrid(*(torch.arange(n, device="cpu") for n in (rows, columns)), indexing="ij")
    xy = geometry.grid.centers(torch.stack((row, column), -1).view(-1, 2)).double()
    points = torch.cat((xy, xy.new_full((len(xy), 1), geometry.height_m)), 1)
    pixel, depth = camera.project(points)
    inside = (depth > MIN_DEPTH_M) & (pixel >= 0).all(-1) & (pixel[:, 0] <= width) & (pixel[:, 1] <= height)
    if geometry.max_pixel_footprint_m < math.inf:
        inside &= _pixel_footprint(camera, points) <= geometry.max_pixel_footprint_m
    cell = inside.nonzero()[:, 0]
    size = torch.tensor(geometry.features[::-1], dtype=torch.float64, device="cpu")
    return cell, ((2 * (pixel[cell] - 0.5) / geometry.stride + 1) / size - 1).float(), depth[cell].float()


def _pixel_footprint(camera: Camera, points: Tensor) -> Tensor:
    """Return the ground length (N,) in metres that one pixel covers along the ray at points (N, 3); large above the
    camera.
    """
    offset = points - camera.agent_from_camera.translation
    return offset.square().sum(1) / (-offset[:, 2] * camera.intrinsic[1, 1]).clamp_min(1e-9)


def lift_ground(
    features: Tensor,
    rig: AgentCameras,
    grid: BevGrid,
    stride: int,
    max_pixel_footprint_m: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Lift features (V, C, h, w) of V cameras by a flat-ground projection.

    Args:
        features: of the images.
        rig: the V cameras.
        grid: ground cells in the agent's frame.
        stride: pixels per feature; the first feature is centred on the first pixel.
        max_pixel_footprint_m: cells of which one pixel covers more along its ray are not observed.

    Returns:
        Features (agents, C, rows, columns), zero where not observed, and the observed mask.
    """
    _check(features, rig)
    geometry = _LiftGeometry(grid, 0.0, max_pixel_footprint_m, _size(features), stride)
    projected = _project_cells(rig.cameras, geometry, features.device)
    return _average_cameras([(projected, projected.valid, _sample(features, projected.place))], rig, grid)


def lift_depth(
    features: Tensor,
    depth: Tensor,
    rig: AgentCameras,
    grid: BevGrid,
    stride: int,
    bins: DepthBins,
    heights_m: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """Lift as in :func:`lift_ground`, with a depth distribution (V, bins.num_bins, h, w) per pixel, at heights_m
    above the road.

    A point takes its pixel's feature times the likelihood of its depth, interpolated linearly; a cell sums over heights. Points
    outside the depth range are not observed.
    """
    _check(features, rig)
    if depth.shape != (features.shape[0], bins.num_bins, *features.shape[-2:]):
        raise ShapeError(
            f"lift_depth needs depth (V, {bins.num_bins}, h, w) beside {tuple(features.shape)}; got {tuple(depth.shape)}."
        )
    found = []
    for height_m in heights_m:
        geometry = _LiftGeometry(grid, height_m, math.inf, _size(features), stride)
        projected = _project_cells(rig.cameras, geometry, features.device)
        bin_at = (projected.depth_m - bins.near_m) / (bins.far_m - bins.near_m) * (bins.num_bins - 1)
        deep = torch.cat((projected.place, (2 * bin_at[..., None] + 1) / bins.num_bins - 1), -1)
        likelihood = _sample(depth[:, None], deep[:, None])
        within = projected.valid & (projected.depth_m >= bins.near_m) & (projected.depth_m <= bins.far_m)
        found.append((projected, within, _sample(features, projected.place) * likelihood))
    return _average_cameras(found, rig, grid)


def _size(features: Tensor) -> tuple[int, int]:
    return features.shape[-2], features.shape[-1]


def _sample(values: Tensor, place: Tensor) -> Tensor:
    """Sample values (V, C, ...) at place (V, ..., M, coordinates), bilinear; returns (V, M, C)."""
    found = F.grid_sample(values, place[:, None], mode="bilinear", padding_mode="border", align_corners=False)
    return found.flatten(2).mT


def _average_cameras(
    found: Sequence[tuple[_ProjectedCells, Tensor, Tensor]], rig: AgentCameras, grid: BevGrid
) -> tuple[Tensor, Tensor]:
    """Average found features (V, M, C), where within (V, M), over the cameras that observe a cell of an agent."""
    _, agent_of_camera, num_agents = rig
    rows, columns = grid.shape
    cells, channels = rows * columns, found[0][2].shape[2]
    total = found[0][2].new_zeros(num_agents * cells, channels)
    visible = total.new_zeros(len(agent_of_camera), cells, dtype=torch.bool)
    camera = torch.arange(len(agent_of_camera), device=total.device)[:, None]
    for projected, within, values in found:
        total = total.index_add(0, (agent_of_camera[:, None] * cells + projected.cell)[within], values[within])
        visible[camera.expand_as(within)[within], projected.cell[within]] = True
    count = (
        total.new_zeros(num_agents, cells)
        .index_add(0, agent_of_camera, visible.to(total.dtype))
        .view(num_agents, rows, columns)
    )
    mean = total.view(num_agents, rows, columns, channels) / count.clamp_min(1)[..., None]
    # channels_last suits the convolutions.
    return mean.permute(0, 3, 1, 2), count > 0


def _check(features: Tensor, rig: AgentCameras) -> None:
    cameras, agent_of_camera, _ = rig
    if features.dim() != 4 or len(cameras) != features.shape[0] or agent_of_camera.shape != (len(cameras),):
        raise ShapeError(
            f"Lifting needs features (V, C, h, w) and agent_of_camera (V,) for {len(cameras)} cameras; got "
            f"{tuple(features.shape)} and {tuple(agent_of_camera.shape)}."
        )
