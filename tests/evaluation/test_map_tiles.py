# SPDX-License-Identifier: Apache-2.0
"""Tiles: what lies in them, and what of it could be seen."""

import math

import numpy as np
import pytest

from manyeyes.datatypes import BevGrid, ConfigError, Transform
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.tiles import check_town_split, crop_to_tile, find_town, place_side_by_side

TILE = BevGrid(-10.0, -5.0, -1.0, 10.0, 5.0, 1.0, pillar=1.0)
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def test_a_line_is_cut_at_the_border_and_moved_into_the_tile():
    # The tile lies at (100, 50) and looks north: the world's north is its x.
    world = MapElements.of([[[98.0, 0.0], [98.0, 100.0]], [[0.0, 0.0], [1.0, 1.0]]], [DIVIDER, DIVIDER])
    cut = crop_to_tile(world, Transform.from_xyz_yaw(100, 50, 0, math.pi / 2), TILE)
    assert len(cut) == 1
    np.testing.assert_allclose(np.sort(cut.polyline(0), axis=0), [[-10, 2], [10, 2]], atol=1e-9)


def test_a_ring_that_is_cut_stays_a_ring_and_slivers_go():
    at = [SQUARE * 2 + [8.0, 0.0], SQUARE * 2 + [9.5, -4.0]]
    cut = crop_to_tile(MapElements.of(at, [CROSSING, CROSSING]), Transform.identity(), TILE)
    # The first keeps 2 of its 4 m, 8 m²; of the second 0.5 x 4 = 2 m² are left.
    assert len(cut) == 1
    ring = cut.polyline(0)
    assert ring[:, 0].max() == 10 and ring[:, 0].min() == 8 and len(ring) == 4
    # A line that leaves and comes back is two; a piece below two metres is none.
    bent = MapElements.of([[[0, 0], [12, 0], [12, 3], [0, 3]], [[9.0, -4.0], [15.0, -4.0]]], DIVIDER)
    assert len(crop_to_tile(bent, Transform.identity(), TILE)) == 2


def test_a_scenario_is_named_after_its_town_and_a_town_is_on_one_side():
    assert find_town("town10hd_0004", ("Town1", "Town10HD")) == "Town10HD"
    with pytest.raises(ConfigError, match="named after none"):
        find_town("city_3", ("Town01",))
    check_town_split(("Town01",), ("Town05",))
    with pytest.raises(ConfigError, match="town05"):
        check_town_split(("Town01", "town05"), ("Town05",))


def test_tiles_do_not_answer_for_each_other():
    line = MapElements.of([[[-10.0, 0.0], [10.0, 0.0]]], DIVIDER)
    both = place_side_by_side([line, line.with_points(line.points + [0.0, 0.2])])
    assert len(both) == 2 and np.ptp(both.points[:, 0]) > 900
