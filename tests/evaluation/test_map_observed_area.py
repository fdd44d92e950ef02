# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.observed_area import clip_to_area, compute_observed_area

VIEW = np.array([(0, -5), (10, -5), (10, 5), (0, 5)], dtype=float)


def test_views_stand_where_the_agents_truly_stood() -> None:
    """One looks east from the origin, one looks north from (20, 0): 10 m ahead, 5 m aside."""
    area = compute_observed_area([VIEW, VIEW], np.array([[0, 0, 0], [20, 0, math.pi / 2]]))
    assert area.area == pytest.approx(200)
    assert area.bounds == pytest.approx((0, -5, 25, 10))


def test_lines_are_cut_and_keep_parts_of_two_metres_and_their_columns() -> None:
    area = compute_observed_area([VIEW], np.zeros((1, 3)))
    lines = [[(-5, 0), (15, 0)], [(8.5, 1), (20, 1)], [(2, 2), (4, 2)], [(-9, 9), (9, 9)]]
    elements = MapElements.of(lines, DIVIDER, [0.1, 0.2, 0.3, 0.4], 0.5)
    got = clip_to_area(elements, area)
    assert [got.polyline(i).tolist() for i in range(len(got))] == [[[0, 0], [10, 0]], [[2, 2], [4, 2]]]
    assert got.score.tolist() == [0.1, 0.3] and got.sigma.tolist() == [0.5] * 4


def test_a_line_that_leaves_and_reenters_becomes_two() -> None:
    area = compute_observed_area([VIEW], np.zeros((1, 3)))
    got = clip_to_area(MapElements.of([[(2, 0), (2, 9), (7, 9), (7, 0)]], DIVIDER), area)
    assert sorted(got.lengths().tolist()) == [5, 5]


def test_a_crossing_is_whole_or_not_there() -> None:
    area = compute_observed_area([VIEW], np.zeros((1, 3)))
    rings = [[(8, 0), (11, 0), (11, 2), (8, 2)], [(9.5, 0), (12.5, 0), (12.5, 2), (9.5, 2)]]
    got = clip_to_area(MapElements.of(rings, CROSSING), area)
    assert len(got) == 1 and got.polyline(0).tolist() == [[8, 0], [11, 0], [11, 2], [8, 2]]
    assert len(clip_to_area(MapElements.empty(), area)) == 0
