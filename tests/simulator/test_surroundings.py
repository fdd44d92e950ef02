# SPDX-License-Identifier: Apache-2.0
"""Trees, yards and furniture beside a crossing of two streets with parked vehicles."""

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, HeightField, Primitives
from manyeyes.simulator.scene.canopy import CanopySpec, place_canopy
from manyeyes.simulator.scene.environment import ENVIRONMENTS, EnvironmentSpec, environment_spec
from manyeyes.simulator.scene.placement import PlacementGrid
from manyeyes.simulator.scene.street_furniture import StreetFurnitureSpec, place_street_furniture
from manyeyes.simulator.scene.surroundings import place_surroundings
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.scene.yards import YardSpec, place_yards
from manyeyes.simulator.sensors.lidar import RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import LidarSpec, spread_beams

MIDDLE = np.zeros(2)
NO_POLES = np.zeros((0, 2))
URBAN = environment_spec("urban-2026")
LEAFY = CanopySpec(trees=(55.0, 55.0), spacing_m=(5.0, 5.0))


def crossing() -> HeightField:
    """Return 200 m of two streets that cross at 0, 0, each 7 m wide with pavements of 2 m, on flat ground."""
    x = np.abs(np.arange(-100, 100, 0.125) + 0.0625)
    u, v = np.meshgrid(x, x)
    surface = np.zeros(u.shape, np.uint8)
    surface[(u < 5.5) | (v < 5.5)] = 3
    surface[(u < 3.5) | (v < 3.5)] = 1
    return HeightField(np.zeros((401, 401), np.float32), surface, -100.0, -100.0, 0.5, 0.125)


def parked(height_m: float = 1.5) -> VehicleStates:
    """Return two rows of cars along the street in x, half on its pavements."""
    x = np.arange(-62, 62, 6.5)
    x = x[np.abs(x) > 9]
    position = np.array([(a, side * 4.6, 0.0) for a in x for side in (-1, 1)])
    n = len(position)
    size, zero = np.tile([4.4, 1.8, height_m], (n, 1)), np.zeros(n)
    return VehicleStates(np.arange(1, n + 1), np.zeros(n, np.int64), position, zero, zero, zero, size)


def around(vehicles: VehicleStates) -> PlacementGrid:
    plot = PlacementGrid.of(crossing())
    for position, size in zip(vehicles.position, vehicles.size):
        plot.occupy_all(position[:2], (size[0] / 2 + 0.2, size[1] / 2 + 0.2), 0.0)
    return plot


def footprint(solids: Primitives, i: int, shrink: float = 1.0) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 15))
    half = shrink * solids.half[i]
    local = np.stack((u * half[0], v * half[1]), -1).reshape(-1, 2)
    return local @ solids.rotation[i, :2, :2].T + solids.center[i, :2]


def assert_off_the_road_and_off_vehicles(solids: Primitives, vehicles: VehicleStates) -> None:
    low = solids.center[:, 2] - solids.half[:, 2]
    for i in range(len(solids)):
        if low[i] > 2.4:
            continue
        rim = footprint(solids, i)
        assert np.abs(rim).min() > 3.5, f"solid {i} is on the road: {solids.half[i]}"
        apart = np.abs(rim[:, None] - vehicles.position[None, :, :2]) - vehicles.size[None, :, :2] / 2
        above = vehicles.position[:, 2] + vehicles.size[:, 2] < low[i]
        assert ((apart > 0).any(-1) | above).all(), f"solid {i} is in a vehicle: {solids.half[i]}"


def test_crowns_hang_over_the_road_and_over_parked_vehicles_above_2_5_m() -> None:
    vehicles = parked()
    solids = place_canopy(around(vehicles), LEAFY, MIDDLE, vehicles, NO_POLES, (3,))
    crown = solids.kind == ELLIPSOID
    assert (solids.density[crown] > 0).all()
    assert (solids.density[~crown] == 0).all()
    low = (solids.center - solids.half)[crown, 2]
    assert low.min() >= 2.5
    assert np.median(low) < 5.0
    over_road = [bool((np.abs(footprint(solids, i, 0.7)).min(1) < 2.0).any()) for i in np.flatnonzero(crown)]
    assert sum(over_road) > 20
    gap = np.hypot(*(vehicles.position[:, None, :2] - solids.center[crown][None, :, :2]).transpose(2, 0, 1))
    assert (gap < solids.half[crown, 0]).any(1).sum() > len(vehicles) / 3
    assert_off_the_road_and_off_vehicles(solids[~crown], vehicles)


def test_crowns_are_lifted_over_high_vehicles() -> None:
    vehicles = parked(3.9)
    solids = place_canopy(around(vehicles), LEAFY, MIDDLE, vehicles, NO_POLES, (3,))
    for i in np.flatnonzero(solids.kind == ELLIPSOID):
        apart = np.abs(vehicles.position[:, :2] - solids.center[i, :2]) - vehicles.size[:, :2] / 2
        under = np.hypot(*np.maximum(apart, 0).T) < solids.half[i, 0]
        assert not under.any() or solids.center[i, 2] - solids.half[i, 2] > 3.9


def test_foliage_keeps_clear_of_roadside_units() -> None:
    vehicles = parked()
    everything = place_canopy(around(vehicles), LEAFY, MIDDLE, vehicles, NO_POLES, (3,))
    crowns = everything[everything.kind == ELLIPSOID]
    pole = crowns.center[:1, :2] + 0.5
    left = place_canopy(around(vehicles), LEAFY, MIDDLE, vehicles, pole, (3,))
    clouds = left[left.kind == ELLIPSOID]
    assert (np.hypot(*(clouds.center[:, :2] - pole).T) >= clouds.half[:, 0] + 2.0).all()
    assert len(crowns) - 8 < len(clouds) < len(crowns)
    np.testing.assert_array_equal(clouds.center[-3:], crowns.center[-3:])


def test_a_fifth_of_the_points_of_a_leafy_street_lies_above_3_m_and_many_over_roofs() -> None:
    vehicles, ground = parked(), crossing()
    solids = place_surroundings(
        PlacementGrid.of(ground), replace(URBAN, canopy=LEAFY), 0.5, 2.0, MIDDLE, (vehicles,), NO_POLES, (3,)
    )
    sensor = LidarSpec(units=(spread_beams(32, -25, 15),), per_turn=720)
    pose = Transform.from_xyz_yaw(-20.0, 0.0, 0.0, 0.0)
    points, _ = scan(RaycastScene(solids, ground), pose, sensor, (1,))
    world = pose.apply(points.xyz.double()).numpy()
    assert (world[:, 2] > 3.0).mean() > 0.2
    apart = np.abs(world[None, :, :2] - vehicles.position[:, None, :2]) - vehicles.size[:, None, :2] / 2
    over = (apart < 0).all(-1) & (world[:, 2] > 1.5)
    assert (over.sum(1) >= 5).sum() >= 8


def test_furniture_stands_off_the_road_and_off_vehicles() -> None:
    vehicles = parked()
    solids = place_street_furniture(around(vehicles), StreetFurnitureSpec(), MIDDLE, (1,))
    assert len(solids) > 60
    assert (solids.kind == CYLINDER).sum() > 10
    assert_off_the_road_and_off_vehicles(solids, vehicles)
    foot = solids.center[:, 2] - solids.half[:, 2]
    assert (foot < 2.6).all()


def test_rails_run_along_the_road() -> None:
    solids = place_street_furniture(PlacementGrid.of(crossing()), StreetFurnitureSpec(4, 0, 0, 0, 0), MIDDLE, (2,))
    rails = solids[solids.half[:, 0] == 2.0]
    assert len(rails) >= 8
    straight = np.abs(rails.center[:, :2]).max(1) > 12
    along = np.abs(rails.rotation[straight][:, :2, 0]).max(1)
    assert (along > 0.99).mean() > 0.9


def test_rooms_are_seen_through_the_openings_of_houses() -> None:
    spec = YardSpec(houses=9, hedges=0, fences=0, bushes=0, sheds=0, pieces=0)
    ground = crossing()
    solids = place_yards(PlacementGrid.of(ground), spec, MIDDLE, (5,))
    thin = np.minimum(solids.half[:, 0], solids.half[:, 1]) < 0.2
    walls = solids[(solids.kind == BOX) & thin]
    assert len(walls) > 40
    points, _ = scan(RaycastScene(solids, ground), Transform.from_xyz_yaw(12.0, 0.0, 0.0, 0.0), LidarSpec(), (1,))
    world = points.xyz.numpy() + [12.0, 0.0, 0.0]
    roofs = solids[np.isclose(solids.half[:, 2], 0.15) & (solids.half[:, :2].min(1) > 2.0)]
    inside = np.zeros(len(world), bool)
    for i in range(len(roofs)):
        local = (world - roofs.center[i]) @ roofs.rotation[i]
        inside |= (np.abs(local[:, :2]) < roofs.half[i, :2] - 0.4).all(1) & (local[:, 2] < 0) & (world[:, 2] > 0.05)
    assert inside.sum() > 100


def test_yards_hold_bushes_of_the_size_of_vehicles_off_the_pavement() -> None:
    solids = place_yards(PlacementGrid.of(crossing()), YardSpec(), MIDDLE, (5,))
    leaves = solids[solids.density > 0]
    assert (leaves.half[:, 1] > 0.6).sum() > 10
    for i in range(len(solids)):
        if solids.center[i, 2] - solids.half[i, 2] < 2.4:
            assert np.abs(footprint(solids, i, 0.9)).min() > 4.5, "on the pavement"
    assert (solids.half > 0).all()


def test_the_key_decides_and_the_classic_world_has_nothing_new() -> None:
    def place(world: EnvironmentSpec, key: int) -> Primitives:
        return place_surroundings(PlacementGrid.of(crossing()), world, 1.0, 2.0, MIDDLE, (parked(),), NO_POLES, (key,))

    one, same, other = (place(URBAN, k) for k in (1, 1, 2))
    np.testing.assert_array_equal(one.center, same.center)
    np.testing.assert_array_equal(one.half, same.half)
    assert len(one) != len(other) or (one.center != other.center).any()
    assert len(one) > 2 * len(place(EnvironmentSpec(), 1))
    assert_off_the_road_and_off_vehicles(one, parked())


def test_an_unknown_environment_lists_the_known_ones() -> None:
    assert list(ENVIRONMENTS) == ["classic", "urban-2026", "urban-2026-no-vehicles"]
    with pytest.raises(ConfigError, match="No environment 'moon'; choose one of classic, urban-2026"):
        environment_spec("moon")
    with pytest.raises(ConfigError, match="min_moving_fraction"):
        EnvironmentSpec(min_moving_fraction=0.0)
    with pytest.raises(ConfigError, match="base_m"):
        CanopySpec(base_m=(5.0, 2.0))
