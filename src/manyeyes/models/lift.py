# SPDX-License-Identifier: Apache-2.0
"""Features of pictures to features of the ground: every cell of the ground asks the pictures what they saw of it.

Two ways with one signature. ``lift_ground`` takes the cell for a piece of a flat road and looks up its pixel (inverse
perspective mapping): no parameters, the plain twin. ``lift_depth`` asks at several heights and believes a pixel as far as it
holds the point's depth for likely: Lift-Splat-Shoot (Philion and Fidler, ECCV 2020) pulled instead of pushed, so that one
bilinear look-up replaces the scatter (specs: maps.md 1.4). Cells that several cameras see are their mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from manyeyes.datatypes import BevGrid, ConfigError, ShapeError
from manyeyes.datatypes.camera import Camera

NEAR_M = 0.5
"""Nearer to a camera than this, nothing is looked up."""


@dataclass(frozen=True)
class DepthBins:
    """count depths in equal steps, the first near_m and the last far_m along the optical axis."""

    near_m: float = 1.0
    far_m: float = 49.0
    count: int = 49

    def __post_init__(self) -> None:
        if not (0 < self.near_m < self.far_m and self.count >= 2):
            raise ConfigError(f"DepthBins needs 0 < near_m < far_m and two bins or more; got {self}.")


@dataclass(frozen=True)
class _LookUp:
    """Of V cameras at every cell of a grid: place (V, rows, columns, 2) in the features, as grid_sample counts; depth_m; inside
    (V, rows, columns), whether the cell is in the picture and ahead of the camera.
    """

    place: Tensor
    depth_m: Tensor
    inside: Tensor


def _look_up(cameras: Sequence[Camera], grid: BevGrid, height_m: float, features: torch.Size, stride: int) -> _LookUp:
    """Where cells of the ground, height_m above the road, lie in features (h, w) whose cell o is centred on pixel stride * o."""
    rows, columns = grid.shape
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    xy = grid.centers(torch.stack((row, column), -1).view(-1, 2)).double()
    points = torch.cat((xy, torch.full((len(xy), 1), height_m, dtype=torch.float64)), 1)
    size = torch.tensor([features[1], features[0]], dtype=torch.float64)
    looks = []
    for camera in cameras:
        pixel, depth = camera.project(points)
        ahead = depth > NEAR_M
        inside = ahead & (pixel >= 0).all(-1) & (pixel[:, 0] <= camera.width) & (pixel[:, 1] <= camera.height)
        place = (2 * (pixel - 0.5) / stride + 1) / size - 1
        looks.append((torch.where(inside[:, None], place, torch.zeros_like(place)).float(), depth.float(), inside))
    places, depths, insides = (torch.stack(column) for column in zip(*looks))
    shape = (len(cameras), rows, columns)
    return _LookUp(places.view(*shape, 2), depths.view(shape), insides.view(shape))


def lift_ground(
    features: Tensor, cameras: Sequence[Camera], owner: Tensor, agents: int, grid: BevGrid, stride: int
) -> tuple[Tensor, Tensor]:
    """Features (V, C, h, w) of V cameras to (agents, C, rows, columns), zero where unseen, and what is seen, bool.

    owner: (V,) int64, whose camera it is. stride: pixels a feature, the first centred on the first pixel.
    """
    _check(features, cameras, owner)
    look = _look_up(cameras, grid, 0.0, features.shape[-2:], stride)
    return _mean_of_cameras(_sample(features, look.place), look.inside, owner, agents)


def lift_depth(
    features: Tensor,
    depth: Tensor,
    cameras: Sequence[Camera],
    owner: Tensor,
    agents: int,
    grid: BevGrid,
    stride: int,
    bins: DepthBins,
    heights_m: Sequence[float],
) -> tuple[Tensor, Tensor]:
    """As :func:`lift_ground`, with depth (V, bins.count, h, w), a distribution a pixel, over heights above the road.

    A point takes its pixel's feature times the likelihood of the point's depth there, linear between bins; a cell is the sum over
    heights. Places beyond the bins are unseen.
    """
    _check(features, cameras, owner)
    if depth.shape != (features.shape[0], bins.count, *features.shape[-2:]):
        raise ShapeError(
            f"lift_depth needs depth (V, {bins.count}, h, w) beside {tuple(features.shape)}; got {tuple(depth.shape)}."
        )
    total = features.new_zeros(features.shape[0], features.shape[1], *grid.shape)
    inside = torch.zeros(features.shape[0], *grid.shape, dtype=torch.bool)
    for height_m in heights_m:
        look = _look_up(cameras, grid, height_m, features.shape[-2:], stride)
        within = look.inside & (look.depth_m >= bins.near_m) & (look.depth_m <= bins.far_m)
        bin_at = (look.depth_m - bins.near_m) / (bins.far_m - bins.near_m) * (bins.count - 1)
        deep = torch.cat((look.place, (2 * bin_at[..., None] + 1) / bins.count - 1), -1)
        likely = _sample(depth[:, None], deep[:, None])[:, :, 0]
        total = total + _sample(features, look.place) * likely * within[:, None]
        inside |= within
    return _mean_of_cameras(total, inside, owner, agents)


def _sample(values: Tensor, place: Tensor) -> Tensor:
    return F.grid_sample(values, place, mode="bilinear", padding_mode="border", align_corners=False)


def _mean_of_cameras(found: Tensor, inside: Tensor, owner: Tensor, agents: int) -> tuple[Tensor, Tensor]:
    share = inside[:, None].to(found.dtype)
    total = found.new_zeros(agents, *found.shape[1:]).index_add(0, owner, found * share)
    count = found.new_zeros(agents, 1, *found.shape[2:]).index_add(0, owner, share)
    return total / count.clamp_min(1), count[:, 0] > 0


def _check(features: Tensor, cameras: Sequence[Camera], owner: Tensor) -> None:
    if features.dim() != 4 or len(cameras) != features.shape[0] or owner.shape != (len(cameras),):
        raise ShapeError(
            f"Lifting needs features (V, C, h, w) and an owner (V,) for each of {len(cameras)} cameras; got "
            f"{tuple(features.shape)} and {tuple(owner.shape)}."
        )
