# SPDX-License-Identifier: Apache-2.0
import numpy as np

from manyeyes.ops.raycast import BOX, ELLIPSOID, HeightField
from manyeyes.simulator.scene.placement import PlacementGrid
from manyeyes.simulator.scene.roadside_objects import (
    RoadsideObjectSpec,
    find_pole_sites,
    make_pole,
    place_roadside_objects,
)

MIDDLE = np.array([100.0, 50.0])


def crossing() -> HeightField:
    """Two roads of 7 m with pavements of 2 m that cross at MIDDLE; the ground rises along x."""
    x = np.arange(-100, 100, 0.125) + 0.0625
    u, v = np.meshgrid(np.abs(x), np.abs(x))
    surface = np.zeros(u.shape, np.uint8)
    surface[(u < 5.5) | (v < 5.5)] = 3
    surface[(u < 3.5) | (v < 3.5)] = 1
    height = np.tile(0.05 * np.arange(0, 200.1, 0.5), (401, 1)).astype(np.float32)
    return HeightField(height, surface, MIDDLE[0] - 100, MIDDLE[1] - 100, 0.5, 0.125)


def test_objects_are_placed_beside_roads_only() -> None:
    solids = place_roadside_objects(PlacementGrid.of(crossing()), RoadsideObjectSpec(), MIDDLE, (0,))
    assert (solids.kind == BOX).sum() > 25
    assert (solids.kind == ELLIPSOID).sum() > 10
    for i in range(len(solids)):
        u, v = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
        rim = np.stack((u * solids.half[i, 0], v * solids.half[i, 1]), -1).reshape(-1, 2) @ solids.rotation[i, :2, :2].T
        away = np.abs(rim + solids.center[i, :2] - MIDDLE).min(1)
        if solids.kind[i] != ELLIPSOID:  # crowns may reach over the road, above 2.3 m
            assert away.min() > 3.5
        bottom = solids.center[i, 2] - solids.half[i, 2] - 0.05 * (solids.center[i, 0] - MIDDLE[0] + 100)
        assert bottom < 0.35 or solids.kind[i] == ELLIPSOID or bottom > 1.5
        assert solids.kind[i] != ELLIPSOID or bottom > 2.0


def test_buildings_do_not_overlap_and_stand_at_the_corners() -> None:
    solids = place_roadside_objects(
        PlacementGrid.of(crossing()), RoadsideObjectSpec(walls=0, poles=0, trees=0, hedges=0), MIDDLE, (1,)
    )
    corners = {tuple(np.sign(c[:2] - MIDDLE)) for c in solids.center if np.abs(c[:2] - MIDDLE).max() < 40}
    assert len(corners) == 4
    grid = PlacementGrid.of(crossing())
    for i in range(len(solids)):
        yaw = float(np.arctan2(solids.rotation[i, 1, 0], solids.rotation[i, 0, 0]))
        half = (float(solids.half[i, 0]) - 0.8, float(solids.half[i, 1]) - 0.8)
        assert grid.occupy_if_free(solids.center[i, :2], half, yaw, 0.0), "two buildings overlap"


def test_the_key_decides_and_parked_cars_are_kept_free() -> None:
    one, same, other = (
        place_roadside_objects(PlacementGrid.of(crossing()), RoadsideObjectSpec(), MIDDLE, (k,)) for k in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.center, same.center)
    assert one.center.shape != other.center.shape or (one.center != other.center).any()
    plot = PlacementGrid.of(crossing())
    plot.occupy(MIDDLE + (20.0, 20.0), (16.0, 16.0), 0.0)
    inside = (
        np.abs(place_roadside_objects(plot, RoadsideObjectSpec(), MIDDLE, (0,)).center[:, :2] - MIDDLE - 20).max(1) < 15
    )
    assert not inside.any()


def test_a_roadside_pole_stands_beside_the_carriageway_near_the_crossing() -> None:
    places = find_pole_sites(PlacementGrid.of(crossing()), MIDDLE)
    away = np.abs(places[:50] - MIDDLE)
    assert (away.min(1) > 3.5).all()
    assert (away.max(1) < 12).all()
    mast = make_pole(places[0], 2.0, 5.0, -1)
    assert mast.instance.tolist() == [-1]
    assert mast.center[0, 2] + mast.half[0, 2] > 7.0
