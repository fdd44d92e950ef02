# SPDX-License-Identifier: Apache-2.0
"""The height of a LiDAR above the road, from its cloud alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datasets.ground_height import estimate_sensor_height
from manyeyes.datatypes import Transform
from manyeyes.ops.raycast import HeightField
from manyeyes.simulator.scene.vehicle_shapes import make_vehicle_shape, place_vehicle_shapes
from manyeyes.simulator.sensors.lidar import ASPHALT, RaycastScene, scan
from manyeyes.simulator.sensors.lidars import lidar_specs


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


def street() -> RaycastScene:
    """Return a flat road with six vehicles, all on one side, where their low parts hide the ground."""
    size = 400
    ground = HeightField(
        np.zeros((size + 1, size + 1), np.float32), np.full((4 * size, 4 * size), ASPHALT, np.uint8), -100.0, -100.0, 0.5, 0.125
    )  # fmt: skip
    places = np.array([[x, y, 0.0] for x in (-12.0, 3.0, 14.0) for y in (4.0, 8.5)])
    ids = np.arange(1, len(places) + 1)
    bodies = [make_vehicle_shape("car", (4.4, 1.8, 1.5), 0, int(i)) for i in ids]
    return RaycastScene(place_vehicle_shapes(bodies, places, np.zeros(len(ids)), np.zeros(len(ids)), ids), ground)


@pytest.mark.parametrize("name", lidar_specs())
def test_each_lidar_of_the_table_at_tilts_up_to_3_degrees(name: str) -> None:
    scene, spec = street(), lidar_specs()[name]
    spec = replace(spec, per_turn=spec.per_turn // 2)
    for roll_deg, pitch_deg in ((0.0, 0.0), (0.0, -1.5), (-2.0, 0.0), (0.0, 3.0), (-2.1, -2.1)):
        tilted = replace(spec, roll_rad=math.radians(roll_deg), pitch_rad=math.radians(pitch_deg))
        points, _ = scan(scene, tilted.agent_pose(Transform.from_xyz_yaw(0, 0)), tilted, (0,))
        xyz = points.xyz.numpy() - np.array([0, 0, spec.height_m], np.float32)
        found = estimate_sensor_height(xyz, 40.0 if spec.height_m > 3 else 25.0)
        assert found == pytest.approx(spec.height_m, abs=0.1), (roll_deg, pitch_deg)


@pytest.mark.parametrize("tilt_deg", [-3.0, 3.0])
@pytest.mark.parametrize("max_range_m", [15.0, 25.0, 40.0])
def test_a_tilt_of_3_degrees_on_an_empty_road(tilt_deg: float, max_range_m: float) -> None:
    assert estimate_sensor_height(cloud(1.9, tilt_deg), max_range_m) == pytest.approx(1.9, abs=0.05)


def test_a_level_storey_below_is_not_the_road() -> None:
    """A car park's lower floor, seen through a gap: the plane of most returns counts."""
    below = cloud(5.0, 0.0, 1500)
    xyz = np.concatenate((cloud(1.9, 1.5), below[below[:, 0] > 20]))
    assert estimate_sensor_height(xyz) == pytest.approx(1.9, abs=0.05)
