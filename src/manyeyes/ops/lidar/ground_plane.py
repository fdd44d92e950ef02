# SPDX-License-Identifier: Apache-2.0
"""The plane of the road in one sweep: slope along x and y, and height.

1. The lowest return of each cell of a grid is a candidate; walls, vehicles and foliage above the road leave few of them wrong.
2. Consensus: of the plane z = 0 and of planes through three candidates, the one that most candidates support and few lie below
   (MSAC: Torr and Zisserman, CVIU 2000).
3. Reweighted least squares (Tukey's biweight) on the candidates, then on the means of the returns near the plane, since the lowest
   of many noisy returns lies below the road.
Weights fall with the range, so that each ring counts the same: a road is a plane nearby, not at 50 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes import ShapeError, Transform
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.ops.lidar._ground_plane_kernels import (
    Tolerance,
    count_cells,
    find_consensus,
    lowest_of_cells,
    mean_of_cells,
    refine,
    ring_weights,
    weighted_moments,
)

Floats = NDArray[np.float64]


class GroundStatus(Enum):
    """Result of a fit.

    FOUND: a plane that differs from z = 0. LEVEL: z = 0 within the dead zone or within the noise of the fit. FEW_POINTS: too few
    candidates, or too few of them on one plane. ILL_CONDITIONED: the visible ground does not determine the slope, as between
    walls. STEEP: the plane is too steep or too far from z = 0. UNEVEN: the road under the sensor lies on z = 0 and not on the
    plane, as on a crest.
    """

    FOUND = "found"
    LEVEL = "level"
    FEW_POINTS = "few points"
    ILL_CONDITIONED = "ill-conditioned"
    STEEP = "steep"
    UNEVEN = "uneven"


@dataclass(frozen=True)
class GroundPlane:
    """The plane z = slope_x * x + slope_y * y + height_m, in the frame of the points.

    covariance: (3, 3) float64 of slope_x, slope_y and height_m, for residuals that are correlated over neighbouring cells.
    """

    slope_x: float
    slope_y: float
    height_m: float
    covariance: Floats

    @property
    def tilt_rad(self) -> float:
        """Angle between the plane and z = 0."""
        return math.atan(math.hypot(self.slope_x, self.slope_y))

    def height_at(self, xy: Tensor) -> Tensor:
        """Return heights (...) in metres of the plane at xy (..., 2)."""
        return self.slope_x * xy[..., 0] + self.slope_y * xy[..., 1] + self.height_m

    def height_sigma_m(self, range_m: float) -> float:
        """Return the standard deviation of the height at a range, at most, in the worst direction."""
        (xx, xy, _), (_, yy, _), (_, _, height_variance) = self.covariance.tolist()
        # The larger eigenvalue of the slopes' covariance.
        slope_variance = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
        return math.sqrt(max(0.0, height_variance)) + range_m * math.sqrt(max(0.0, slope_variance))

    def levelled_from_points(self) -> Transform:
        """Return the motion that puts the plane at z = 0: the smallest rotation, which turns no heading, then a shift along z."""
        normal = torch.tensor([-self.slope_x, -self.slope_y, 1.0], dtype=torch.float64, device="cpu")
        length = float(normal.norm())
        a, b, c = (normal / length).tolist()
        # Rodrigues' formula about (b, -a, 0), from the normal to +z.
        rotation = [[1 - a * a / (1 + c), -a * b / (1 + c), -a], [-a * b / (1 + c), 1 - b * b / (1 + c), -b], [a, b, c]]
        shift = torch.tensor([0.0, 0.0, -self.height_m / length], dtype=torch.float64, device="cpu")
        return Transform(torch.tensor(rotation, dtype=torch.float64, device="cpu"), shift)


@dataclass(frozen=True)
class GroundFit:
    """Status of a fit, and its plane: None only where there were too few candidates for any."""

    status: GroundStatus
    plane: GroundPlane | None = None


@dataclass(frozen=True)
class GroundPlaneConfig:
    """Settings of the fit.

    Attributes:
        cell_m: edge of a cell.
        max_range_m: range of candidates.
        max_offset_m: maximum height of the plane at the origin.
        max_tilt_rad: maximum tilt of the plane.
        min_cells: minimum number of cells on the plane.
        min_cell_fraction: minimum weighted fraction of cells on the plane.
        max_height_sigma_m: maximum standard deviation of the height at sigma_range_m.
        sigma_range_m: range at which it applies.
        near_range_m: range of the road under the sensor, which a plane has to support better than z = 0 does.
        level_tilt_rad: dead zone of the tilt.
        level_offset_m: dead zone of the height.
        max_points: of more points, every n-th is used.
    """

    cell_m: float = 2.0
    max_range_m: float = 50.0
    max_offset_m: float = 1.0
    max_tilt_rad: float = math.radians(6.0)
    min_cells: int = 40
    min_cell_fraction: float = 0.25
    max_height_sigma_m: float = 0.15
    sigma_range_m: float = 30.0
    near_range_m: float = 12.0
    level_tilt_rad: float = math.radians(0.1)
    level_offset_m: float = 0.05
    max_points: int = 40_000


DEFAULT_GROUND_CONFIG = GroundPlaneConfig()
_CONSENSUS, _CANDIDATES = Tolerance(0.15, 0.006), Tolerance(0.15, 0.006)
_BAND, _MEANS = Tolerance(0.12, 0.004), Tolerance(0.12, 0.004)
_NUM_PLANES = 100
_BELOW_FACTOR = 1.0
_RING_M = 5.0
_CORRELATED_CELLS = 10.0
"""Residuals of about so many neighbouring cells are equal."""
_MIN_RESIDUAL_M = 0.02
_NEAR_TOLERANCE_M = 0.2


def fit_ground_plane(points: Tensor, config: GroundPlaneConfig = DEFAULT_GROUND_CONFIG) -> GroundFit:
    """Fit the plane of the road to points (N, 3), metres, z up, with the road near z = 0; deterministic.

    Raises:
        ShapeError: another shape.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError(f"fit_ground_plane needs points (N, 3); got {tuple(points.shape)}.")
    stride = max(1, -(-len(points) // config.max_points))
    xyz = points.detach()[::stride].cpu().to(torch.float32).contiguous().numpy()
    max_slope = math.tan(config.max_tilt_rad)
    lowest, cell_of_point = lowest_of_cells(xyz, config.cell_m, config.max_range_m, config.max_offset_m, max_slope)
    if len(lowest) < config.min_cells:
        return GroundFit(GroundStatus.FEW_POINTS)
    num_cells = count_cells(config.cell_m, config.max_range_m) ** 2
    ranges, weight = ring_weights(lowest, _RING_M)
    plane = find_consensus(lowest, weight, ranges, _CONSENSUS, _draws(), max_slope, _BELOW_FACTOR)
    plane, support = refine(lowest, weight, ranges, _CANDIDATES, plane, 5)
    fraction = float((weight * (support > 0)).sum() / weight.sum())
    means = mean_of_cells(xyz, cell_of_point, num_cells, plane, _BAND)
    if len(means) < config.min_cells or fraction < config.min_cell_fraction:
        return GroundFit(GroundStatus.FEW_POINTS)
    ranges, weight = ring_weights(means, _RING_M)
    plane, weight = refine(means, weight, ranges, _MEANS, plane, 3)
    if int((weight > 0).sum()) < config.min_cells:
        return GroundFit(GroundStatus.FEW_POINTS)
    fitted = GroundPlane(float(plane[0]), float(plane[1]), float(plane[2]), _covariance(means, weight, plane))
    return GroundFit(_classify(fitted, lowest, config), fitted)


def _classify(plane: GroundPlane, lowest: Floats, config: GroundPlaneConfig) -> GroundStatus:
    """Return the status of a plane with enough support; lowest: (K, 3), the candidates."""
    if plane.height_sigma_m(config.sigma_range_m) > config.max_height_sigma_m:
        return GroundStatus.ILL_CONDITIONED
    if plane.tilt_rad > config.max_tilt_rad or abs(plane.height_m) > config.max_offset_m:
        return GroundStatus.STEEP
    slope, value = np.array([plane.slope_x, plane.slope_y]), plane.covariance
    is_level = plane.tilt_rad <= config.level_tilt_rad or slope @ np.linalg.solve(value[:2, :2], slope) < 9.0
    if is_level and abs(plane.height_m) <= max(config.level_offset_m, 3.0 * math.sqrt(value[2, 2])):
        return GroundStatus.LEVEL
    near = _near_support(lowest, np.array([*slope, plane.height_m]), config)
    return GroundStatus.FOUND if near >= _near_support(lowest, np.zeros(3), config) else GroundStatus.UNEVEN


def _covariance(places: Floats, weight: Floats, plane: Floats) -> Floats:
    """Return the covariance (3, 3) of a weighted fit whose residuals have one variance and are correlated over neighbours."""
    once, twice, mean_square = weighted_moments(places, weight, plane)
    inverse = np.linalg.inv(once)
    return _CORRELATED_CELLS * max(_MIN_RESIDUAL_M**2, mean_square) * inverse @ twice @ inverse


def _near_support(lowest: Floats, plane: Floats, config: GroundPlaneConfig) -> float:
    """Return the number of candidates within near_range_m that a plane supports, weighted by their distance from it."""
    near = lowest[np.hypot(lowest[:, 0], lowest[:, 1]) < config.near_range_m]
    distance = (near[:, 2] - near[:, :2] @ plane[:2] - plane[2]) / _NEAR_TOLERANCE_M
    return float(np.clip(1.0 - distance**2, 0.0, None).sum())


@cache
def _draws() -> Floats:
    """Return the keyed draws (H, 3) that select the candidates of each plane."""
    return keyed_uniform((_NUM_PLANES, 3), 0, "ground-plane").numpy()
