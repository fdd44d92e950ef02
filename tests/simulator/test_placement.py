# SPDX-License-Identifier: Apache-2.0
import numpy as np
from scipy.ndimage import distance_transform_edt

from manyeyes.ops.raycast import BOX, HeightField
from manyeyes.simulator.scene.placement import PlacementGrid, SolidList, distance_transform


def street() -> HeightField:
    """Return 80 m of a road along x, 7 m wide, with pavements of 2 m, on flat ground."""
    y = np.abs(np.arange(-40, 40, 0.125) + 0.0625)
    row = np.where(y < 3.5, 1, np.where(y < 5.5, 3, 0)).astype(np.uint8)
    return HeightField(np.zeros((161, 161), np.float32), np.tile(row[:, None], (1, 640)), -40.0, -40.0, 0.5, 0.125)


def test_distances_are_euclidean() -> None:
    blocked = np.random.default_rng(0).random((60, 47)) < 0.03
    np.testing.assert_allclose(distance_transform(blocked), distance_transform_edt(~blocked), atol=1e-9)


def test_clearances_are_measured_from_the_edge_and_point_away() -> None:
    grid = PlacementGrid.of(street())
    distance, away = grid.road_clearance(np.array([3.0, 6.2]))
    assert abs(distance - 2.7) < 0.5
    np.testing.assert_allclose(away, [0.0, 1.0], atol=1e-9)
    distance, away = grid.pavement_clearance(np.array([3.0, -8.2]))
    assert abs(distance - 2.7) < 0.5
    np.testing.assert_allclose(away, [0.0, -1.0], atol=1e-9)


def test_a_place_is_taken_once_and_not_on_the_road() -> None:
    grid = PlacementGrid.of(street())
    assert not grid.occupy_if_free(np.array([0.0, 3.6]), (0.3, 0.3), 0.0, 0.0, 0.5)
    assert grid.occupy_if_free(np.array([0.0, 8.0]), (2.0, 0.5), 0.3, 0.0, 0.5)
    assert not grid.occupy_if_free(np.array([1.0, 8.3]), (0.2, 0.2), 0.0, 0.0, 0.5)


def test_a_turned_rectangle_is_taken_without_holes() -> None:
    grid, half, yaw = PlacementGrid.of(street()), (2.4, 0.9), 0.9
    grid.occupy_all(np.array([1.3, 12.1]), half, yaw)
    rng = np.random.default_rng(0)
    local = rng.uniform(-1, 1, (2000, 2)) * half
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    row, column, _ = grid.index(local @ turn + [1.3, 12.1])
    assert grid.is_occupied[row, column].all()
    assert grid.is_occupied.sum() < 60
    grid.occupy_all(np.array([39.9, 39.9]), half, yaw)


def test_solids_keep_what_they_were_added_with() -> None:
    heap = SolidList([])
    assert len(heap.solids()) == 0
    heap.add(BOX, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), np.pi / 2, density=0.5, instance=7, reflectivity=0.9)
    solids = heap.solids()
    np.testing.assert_allclose(solids.rotation[0] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert (solids.density[0], solids.instance[0], solids.reflectivity[0]) == (0.5, 7, 0.9)
