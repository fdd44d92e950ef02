# SPDX-License-Identifier: Apache-2.0
"""The height of a LiDAR above the road, from its cloud alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datasets.ground_height import estimate_sensor_height


def cloud(height_m: float, tilt_deg: float, count: int = 8000) -> np.ndarray:
    """Flat road with 2 cm noise in the frame of a LiDAR whose x axis points down by the tilt, height_m above the road along z."""
    rng = np.random.default_rng(0)
    radius, angle = rng.uniform(4, 45, count), rng.uniform(-math.pi, math.pi, count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = -height_m + math.tan(math.radians(tilt_deg)) * x + 0.02 * rng.standard_normal(count)
    return np.stack((x, y, z), 1).astype(np.float32)


@pytest.mark.parametrize("tilt_deg", [0.0, 0.78, -2.0])
@pytest.mark.parametrize("height_m", [1.9, 6.0])
def test_the_height_is_that_straight_below_the_sensor(height_m: float, tilt_deg: float) -> None:
    assert estimate_sensor_height(cloud(height_m, tilt_deg), 15.0) == pytest.approx(height_m, abs=0.02)


def test_a_few_near_returns_give_the_lowest_twentieth() -> None:
    xyz = cloud(2.0, 0.0)
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < 6][:150]
    assert estimate_sensor_height(xyz) == pytest.approx(2.0, abs=0.06)
    assert estimate_sensor_height(xyz[:50]) == 1.9
