# SPDX-License-Identifier: Apache-2.0
"""Global registration of two clouds without a prior: correlate rasters of vertical structures over all yaws and shifts, then
refine and compare the best candidates.

Only columns whose points differ in height count: walls, trunks, vehicles. The ground carries no information on a shift. The
correlation over all shifts of one yaw is a product of Fourier transforms (Reddy and Chatterji, IEEE TIP 5(8), 1996, for
images; Barnea and Silverman 1972 for the search over offsets). The refinement climbs the likelihood field of the ego's columns
(Thrun, Burgard, Fox: Probabilistic Robotics, 6.4). An estimate needs a minimum inlier fraction and a margin over the best
distinct other candidate, so that a repetitive street gives none. x, y and yaw are found; clouds are upright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError, PointCloud
from manyeyes.pose.corrector import mahalanobis_squared
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3, no_estimate, pose_difference

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]


@dataclass(frozen=True)
class RegistrationConfig:
    """max_range_m: columns farther from the sensor are left out. column_m: edge of a column; min_height_m: height range of its
    points. cell_m, num_yaw_steps: of the search over all poses; fine_step_m, blur_m: cell and Gaussian of the field that
    refines. num_candidates: candidates that are refined; those within min_separation_m and min_separation_rad of a better one
    are the same. min_inlier_fraction: mean field value at the other's columns; min_margin: over the runner-up. sigma_m,
    sigma_yaw_rad: standard deviations of an estimate.
    """

    max_range_m: float = 60.0
    column_m: float = 0.3
    min_height_m: float = 0.6
    cell_m: float = 1.0
    num_yaw_steps: int = 120
    fine_step_m: float = 0.2
    blur_m: float = 0.4
    num_candidates: int = 6
    min_separation_m: float = 3.0
    min_separation_rad: float = 0.12
    min_inlier_fraction: float = 0.3
    min_margin: float = 0.1
    sigma_m: float = 0.1
    sigma_yaw_rad: float = 0.005

    def __post_init__(self) -> None:
        lengths = (
            self.max_range_m,
            self.column_m,
            self.min_height_m,
            self.cell_m,
            self.fine_step_m,
            self.blur_m,
            self.sigma_m,
        )
        if min(lengths) <= 0 or self.num_yaw_steps < 1 or self.num_candidates < 2:
            raise ConfigError("RegistrationConfig needs lengths above 0, num_yaw_steps >= 1 and num_candidates >= 2.")


@dataclass(frozen=True)
class LikelihoodField:
    """Proximity of each cell to a vertical structure, 1 on it: (rows, columns) over a square of half_size_m around the sensor."""

    value: Pixels
    half_size_m: float
    cell_m: float

    @classmethod
    def of(cls, xy: Floats, half_size_m: float, cell_m: float, blur_m: float) -> LikelihoodField:
        """Return the field of columns at (N, 2)."""
        side = 2 * math.ceil(half_size_m / cell_m)
        value = np.zeros((side, side), np.float32)
        at = np.floor((xy + half_size_m) / cell_m).astype(int)
        at = at[((at >= 0) & (at < side)).all(1)]
        value[at[:, 1], at[:, 0]] = 1
        return cls(_dilate_gaussian(value, blur_m / cell_m), half_size_m, cell_m)

    def sample(self, xy: Floats) -> Floats:
        """Return values at positions (..., 2), bilinear, 0 outside."""
        place = (xy + self.half_size_m) / self.cell_m - 0.5
        low = np.floor(place)
        part = place - low
        rows, columns = self.value.shape
        # Two rings of zeros: positions farther out are taken to them.
        x, y = (np.clip(low[..., k], -2, size).astype(np.intp) for k, size in ((0, columns), (1, rows)))
        corner = (y + 2) * (columns + 4) + x + 2
        total = np.zeros(xy.shape[:-1])
        for dx in (0, 1):
            for dy in (0, 1):
                weight = np.abs(1 - dx - part[..., 0]) * np.abs(1 - dy - part[..., 1])
                total += weight * self._padded[corner + (dy * (columns + 4) + dx)]
        return total

    @cached_property
    def _padded(self) -> Pixels:
        return np.pad(self.value, 2).ravel()


@register_pose_corrector("scan-registration", "clouds")
def register_clouds(
    ego: PointCloud, other: PointCloud, prior: PosePrior | None, config: RegistrationConfig | None = None
) -> PoseEstimate:
    """Estimate ego_from_other from two clouds; the prior gives height and tilt only."""
    config = config or RegistrationConfig()
    here, there = (extract_vertical_structures(cloud, config) for cloud in (ego, other))
    if min(len(here), len(there)) < 3:
        return no_estimate(prior)
    field = LikelihoodField.of(here, config.max_range_m, config.fine_step_m, config.blur_m)
    refined = [_climb(pose, there, field) for pose in _peaks(here, there, config)]
    refined.sort(key=lambda found: -found[1])
    (pose, inlier_fraction), *others = refined
    other_scores = [s for p, s in others if not _is_alike(p, pose, config)]
    margin = inlier_fraction - max(other_scores, default=0.0)
    if inlier_fraction < config.min_inlier_fraction:
        return no_estimate(prior)
    if margin < config.min_margin:
        return no_estimate(prior, PoseStatus.AMBIGUOUS)
    covariance = np.diag([config.sigma_m**2, config.sigma_m**2, config.sigma_yaw_rad**2])
    distance = float("nan") if prior is None else mahalanobis_squared(pose, covariance, prior)
    none, count = np.zeros((0, 2), np.int64), round(inlier_fraction * len(there))
    return PoseEstimate(
        lift_to_se3(pose, prior), covariance, PoseStatus.CORRECTED, count, 0, margin, none, pose, covariance, distance
    )


def extract_vertical_structures(cloud: PointCloud, config: RegistrationConfig) -> Floats:
    """Return (N, 2) centres of the columns within range whose points differ enough in height."""
    xyz = cloud.xyz.double().numpy()
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < config.max_range_m]
    cell = np.floor(xyz[:, :2] / config.column_m).astype(np.int64)
    _, column = np.unique((cell[:, 0] << 32) + cell[:, 1], return_inverse=True)
    order = np.lexsort((xyz[:, 2], column))
    starts = np.flatnonzero(np.diff(column[order], prepend=-1))
    if not len(starts):
        return np.zeros((0, 2))
    ends = np.append(starts[1:], len(order)) - 1
    z, count = xyz[order, 2], np.diff(np.append(starts, len(order)))
    middle = np.add.reduceat(xyz[order, :2], starts) / count[:, None]
    return middle[z[ends] - z[starts] >= config.min_height_m]


def _peaks(here: Floats, there: Floats, config: RegistrationConfig) -> list[Floats]:
    """Return poses (3,) of the best distinct overlaps among all yaws and all shifts of whole cells."""
    side = 2 * math.ceil(config.max_range_m / config.cell_m)
    own = LikelihoodField.of(here, config.max_range_m, config.cell_m, config.cell_m).value
    # Twice the side, so that no shift wraps around.
    spectrum = torch.fft.rfft2(torch.from_numpy(own), s=(2 * side, 2 * side))
    found: list[tuple[float, Floats]] = []
    for k in range(config.num_yaw_steps):
        yaw = 2 * math.pi * k / config.num_yaw_steps
        drawn = np.zeros((side, side), np.float32)
        at = np.floor((_rotate(there, yaw) + config.max_range_m) / config.cell_m).astype(int)
        at = at[((at >= 0) & (at < side)).all(1)]
        drawn[at[:, 1], at[:, 0]] = 1
        drawn /= max(float(drawn.sum()), 1.0)
        overlap = torch.fft.irfft2(spectrum * torch.fft.rfft2(torch.from_numpy(drawn), s=(2 * side, 2 * side)).conj())
        for _ in range(2):
            best = int(overlap.argmax())
            row, column = divmod(best, 2 * side)
            shift = np.array([(i + side) % (2 * side) - side for i in (column, row)]) * config.cell_m
            found.append((float(overlap[row, column]), np.array([*shift, yaw])))
            near = [torch.arange(i - 3, i + 4) % (2 * side) for i in (row, column)]
            overlap[near[0][:, None], near[1]] = -1
    kept: list[Floats] = []
    for _, pose in sorted(found, key=lambda f: -f[0]):
        if len(kept) < config.num_candidates and not any(_is_alike(pose, other, config) for other in kept):
            kept.append(pose)
    return kept


def _climb(pose: Floats, there: Floats, field: LikelihoodField) -> tuple[Floats, float]:
    """Hill climbing from a pose by steps that halve, and the mean of the field at the columns there."""
    step = np.array([1.0, 1.0, 0.03])
    best, height = pose, float(field.sample(_transform(there, pose)).mean())
    moves = np.concatenate((np.eye(3), -np.eye(3)))
    while step[0] > 0.01:
        tried = best + moves * step
        heights = [float(field.sample(_transform(there, p)).mean()) for p in tried]
        top = int(np.argmax(heights))
        if heights[top] > height:
            best, height = tried[top], heights[top]
        else:
            step = step / 2
    return np.array([best[0], best[1], (best[2] + np.pi) % (2 * np.pi) - np.pi]), height


def _rotate(xy: Floats, yaw: float) -> Floats:
    c, s = math.cos(yaw), math.sin(yaw)
    return xy @ np.array([[c, s], [-s, c]])


def _transform(xy: Floats, pose: Floats) -> Floats:
    return _rotate(xy, float(pose[2])) + pose[:2]


def _is_alike(a: Floats, b: Floats, config: RegistrationConfig) -> bool:
    apart = pose_difference(a, b)
    return bool(np.hypot(apart[0], apart[1]) < config.min_separation_m and abs(apart[2]) < config.min_separation_rad)


def _dilate_gaussian(value: Pixels, sigma: float) -> Pixels:
    """Return the maximum of Gaussians around every set cell, to three sigma: 1 where set."""
    radius = math.ceil(3 * sigma)
    out = torch.from_numpy(value)[None, None]
    for axis_step in ((1, 0), (0, 1)):
        shifted = []
        for k in range(-radius, radius + 1):
            moved = torch.roll(out, (k * axis_step[0], k * axis_step[1]), (2, 3))
            shifted.append(moved * math.exp(-(k**2) / (2 * sigma**2)))
        out = torch.stack(shifted).amax(0)
    return out[0, 0].numpy()
