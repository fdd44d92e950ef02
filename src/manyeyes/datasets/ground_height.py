# SPDX-License-Identifier: Apache-2.0
"""How high a LiDAR stands above the road, where its recording does not say so."""

from __future__ import annotations

import numpy as np
import torch

from manyeyes.ops.lidar.ground_plane import DEFAULT_GROUND_CONFIG, GroundStatus, fit_ground_plane

PLAUSIBLE_HEIGHT_M = (0.3, 20.0)
_DEFAULT_HEIGHT_M = 1.9
_MIN_POINTS = 100
# Of the lowest twentieth, a tilt of 3 degrees makes a height of up to 2 m too much.
_START_OFFSETS_M = (0.0, -0.8, 0.8, -1.6, 1.6)
_NUM_FITS, _MAX_REST_M = 3, 0.1
_MAX_ILL_CONDITIONED_SIGMA_M = 0.25


def estimate_sensor_height(xyz: np.ndarray, max_range_m: float = 25.0) -> float:
    """Return the height of the LiDAR above the plane of the road, metres, straight below it along its own z axis.

    The plane is fitted again about the height found, until it passes through z = 0: a fit needs the road near there. Where no
    plane is found, the height is that of the lowest twentieth of what is below the sensor within max_range_m. 1.9 m where fewer
    than 100 points are below, or the answer is not plausible. xyz: (N, 3) metres in the LiDAR's frame.
    """
    low, high = PLAUSIBLE_HEIGHT_M
    near = xyz[(np.hypot(xyz[:, 0], xyz[:, 1]) < max_range_m) & (xyz[:, 2] < -low), 2]
    if len(near) < _MIN_POINTS:
        return _DEFAULT_HEIGHT_M
    start = -float(np.percentile(near, 5))
    points = torch.from_numpy(np.asarray(xyz, np.float32))
    uncertain: list[tuple[float, float]] = []
    for offset in _START_OFFSETS_M:
        sigma, height = _fit_height(points, start + offset)
        if sigma == 0.0 and low <= height <= high:
            return height
        uncertain.append((sigma, height))
    sigma, height = min(uncertain)
    height = height if sigma <= _MAX_ILL_CONDITIONED_SIGMA_M else start
    return height if low <= height <= high else _DEFAULT_HEIGHT_M


def _fit_height(points: torch.Tensor, height: float) -> tuple[float, float]:
    """Return the standard deviation at 30 m and the height of the plane that fits from a first height lead to.

    The deviation is 0 for a sound plane, else that of the best of those that the visible road does not determine well, infinite
    where there is none.
    """
    best = (float("inf"), height)
    for _ in range(_NUM_FITS):
        fit = fit_ground_plane(points + torch.tensor([0.0, 0.0, height]))
        if fit.plane is None:
            break
        height -= fit.plane.height_m
        if fit.status in (GroundStatus.FOUND, GroundStatus.LEVEL) and abs(fit.plane.height_m) < _MAX_REST_M:
            return 0.0, height
        if fit.status is GroundStatus.ILL_CONDITIONED:
            best = min(best, (fit.plane.height_sigma_m(DEFAULT_GROUND_CONFIG.sigma_range_m), height))
    return best
