# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.scene.terrain import TerrainSpec, add_terrain, height_at, stand_on_ground, wheel_points
from manyeyes.simulator.scene.vehicle_shapes import rotation_from_yaw_pitch
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.sensors.lidar import RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import LidarSpec, spread_beams

MIDDLE = np.zeros(2)
STEEP = TerrainSpec(
    (0.03, 0.03), (0.02, 0.02), (80.0, 150.0), (0.03, 0.03), 5.0, (0.12, 0.12), (0.5, 0.5), (0.05, 0.05)
)
FLAT = TerrainSpec((0.0, 0.0), (0.0, 0.0), (80.0, 80.0), (0.0, 0.0), 5.0, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


def street() -> HeightField:
    """Return 160 m of a road along x, 10 m wide, with pavements of 2 m, on flat ground."""
    y = np.abs(np.arange(-80, 80, 0.125) + 0.0625)
    row = np.where(y < 5.0, 1, np.where(y < 7.0, 3, 0)).astype(np.uint8)
    return HeightField(np.zeros((321, 321), np.float32), np.tile(row[:, None], (1, 1280)), -80.0, -80.0, 0.5, 0.125)


def vehicles(count: int) -> VehicleStates:
    rng = np.random.default_rng(3)
    size = np.tile([4.5, 1.8, 1.5], (count, 1))
    position = np.concatenate(
        (rng.uniform(-70, 70, (count, 1)), rng.uniform(-3, 3, (count, 1)), np.zeros((count, 1))), 1
    )
    yaw, zero = rng.normal(0, 0.05, count) + np.pi * (rng.random(count) < 0.5), np.zeros(count)
    return VehicleStates(np.arange(1, count + 1), np.zeros(count, np.int64), position, yaw, zero, zero, size)


def test_a_flat_terrain_adds_nothing_and_the_key_decides() -> None:
    np.testing.assert_array_equal(add_terrain(street(), FLAT, MIDDLE, (1,)).height, street().height)
    one, same, other = (add_terrain(street(), STEEP, MIDDLE, (k,)).height for k in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.5


def test_the_road_is_crowned_between_kerbs() -> None:
    spec = replace(FLAT, cross_slope=(0.02, 0.02), kerb_m=(0.12, 0.12))
    ground = add_terrain(street(), spec, MIDDLE, (1,))
    middle, quarter, edge, pavement = height_at(ground, np.array([[0.0, 0.0], [0.0, 2.5], [0.0, 4.25], [0.0, 6.0]]))
    assert middle - quarter == pytest.approx(0.05, abs=0.012)
    assert quarter - edge == pytest.approx(0.035, abs=0.012)
    assert pavement - edge == pytest.approx(0.12, abs=0.03)
    assert height_at(ground, np.array([[0.0, -4.25]]))[0] == pytest.approx(edge, abs=0.012)


def test_slopes_stay_within_a_few_percent() -> None:
    """The sum of hills, tilt and crown along the road's middle; hills of several waves peak at about three times their mean."""
    for key in range(6):
        ground = add_terrain(street(), replace(STEEP, kerb_m=(0.0, 0.0)), MIDDLE, (key,))
        along = np.diff(ground.height[160], axis=0) / 0.5
        assert 0.01 < np.abs(along).max() < 0.15


def test_wheels_stand_on_the_road() -> None:
    ground = add_terrain(street(), STEEP, MIDDLE, (4,))
    states = stand_on_ground(vehicles(60), ground)
    assert np.abs(states.pitch).max() > 0.02
    assert np.abs(states.roll).max() > 0.02
    wheel = wheel_points(states)
    local = np.concatenate(
        (np.array([[0.3, 0.4], [0.3, -0.4], [-0.3, -0.4], [-0.3, 0.4]]) * [4.5, 1.8], np.zeros((4, 1))), 1
    )
    rotation = rotation_from_yaw_pitch(states.yaw, states.pitch, states.roll)
    placed = np.einsum("nij,kj->nki", rotation, local) + states.position[:, None]
    assert np.abs(placed[..., :2] - wheel).max() < 0.02
    assert np.abs(placed[..., 2] - height_at(ground, placed[..., :2])).max() < 0.05


def test_an_empty_fleet_is_placed() -> None:
    assert len(stand_on_ground(VehicleStates.empty(), street())) == 0


def test_ground_returns_fit_the_declared_heights() -> None:
    ground = add_terrain(street(), STEEP, MIDDLE, (4,))
    states = stand_on_ground(vehicles(1), ground)
    rotation = rotation_from_yaw_pitch(states.yaw, states.pitch, states.roll)[0]
    pose = Transform(torch.from_numpy(rotation), torch.from_numpy(states.position[0]))
    sensor = LidarSpec(units=(spread_beams(32, -25, 2),), per_turn=360, range_sigma_m=0.01)
    points, _ = scan(RaycastScene(Primitives.empty(), ground), pose, sensor, (1,))
    world = pose.apply(points.xyz.double()).numpy()
    near = np.hypot(*(world[:, :2] - states.position[0, :2]).T) < 60
    error = world[near, 2] - height_at(ground, world[near, :2])
    assert near.sum() > 3000
    assert np.abs(error).max() < 0.06
    assert np.ptp(world[near, 2]) > 1.0


def test_nonsense_is_refused() -> None:
    with pytest.raises(ConfigError, match="slopes within"):
        TerrainSpec(grade=(0.05, 0.01))
    with pytest.raises(ConfigError, match="wavelengths"):
        TerrainSpec(wavelength_m=(5.0, 10.0))
