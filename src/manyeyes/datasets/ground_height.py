# SPDX-License-Identifier: Apache-2.0
"""How high a LiDAR stands above the road, where its recording does not say so."""

from __future__ import annotations

import numpy as np
import torch

from manyeyes.ops.lidar.ground_plane import GroundStatus, fit_ground_plane

PLAUSIBLE_HEIGHT_M = (0.3, 20.0)
_DEFAULT_HEIGHT_M = 1.9


def estimate_sensor_height(xyz: np.ndarray, max_range_m: float = 25.0) -> float:
    """Return the height of the LiDAR above the plane of the road, metres, straight below it along its own z axis.

    Where no plane is found, it is that of the lowest twentieth of what is below the sensor within max_range_m. 1.9 m where fewer
    than 100 points are below, or the answer is not plausible. xyz: (N, 3) metres in the LiDAR's frame.
    """
    low, high = PLAUSIBLE_HEIGHT_M
    near = xyz[(np.hypot(xyz[:, 0], xyz[:, 1]) < max_range_m) & (xyz[:, 2] < -low), 2]
    if len(near) < 100:
        return _DEFAULT_HEIGHT_M
    height = -float(np.percentile(near, 5))
    if not low <= height <= high:
        return _DEFAULT_HEIGHT_M
    points = torch.from_numpy(np.asarray(xyz, np.float32)) + torch.tensor([0.0, 0.0, height])
    fit = fit_ground_plane(points)
    if fit.plane is not None and fit.status in (GroundStatus.FOUND, GroundStatus.LEVEL):
        height -= fit.plane.height_m
    return height
