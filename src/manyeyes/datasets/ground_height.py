# SPDX-License-Identifier: Apache-2.0
"""How high a LiDAR stands above the road, where its recording does not say so."""

from __future__ import annotations

import numpy as np

PLAUSIBLE_HEIGHT_M = (0.3, 20.0)
_DEFAULT_HEIGHT_M = 1.9


def estimate_sensor_height(xyz: np.ndarray, max_range_m: float = 25.0) -> float:
    """Return the height that puts the road at z = 0: the lowest twentieth of what is below the sensor within max_range_m.

    xyz: (N, 3) metres in the LiDAR's frame. 1.9 m where fewer than 100 points are below, or the answer is not plausible.
    """
    low, high = PLAUSIBLE_HEIGHT_M
    near = xyz[(np.hypot(xyz[:, 0], xyz[:, 1]) < max_range_m) & (xyz[:, 2] < -low), 2]
    if len(near) < 100:
        return _DEFAULT_HEIGHT_M
    height = -float(np.percentile(near, 5))
    return height if low <= height <= high else _DEFAULT_HEIGHT_M
