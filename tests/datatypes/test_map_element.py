# SPDX-License-Identifier: Apache-2.0
"""Elements of a map as columns: what a table holds, gives back and refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datatypes import ShapeError
from manyeyes.datatypes.map_element import CROSSING, DASHED, DIVIDER, MapElements, Polygons

LINE = [[0.0, 0.0], [3.0, 4.0], [3.0, 10.0]]
SQUARE = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]


def two() -> MapElements:
    return MapElements.of([LINE, SQUARE], [DIVIDER, CROSSING], score=[0.5, 0.9], sigma=0.2, style=[DASHED, 3])


def test_a_ring_is_measured_with_its_closing_edge() -> None:
    assert two().lengths().tolist() == [11.0, 8.0]


def test_bounds_hold_each_element_and_an_empty_one_has_none() -> None:
    elements = MapElements.of([LINE, [], SQUARE], 0)
    assert elements.bounds().tolist() == [
        [0.0, 0.0, 3.0, 10.0],
        [math.inf, math.inf, -math.inf, -math.inf],
        [0.0, 0.0, 2.0, 2.0],
    ]


def test_taken_rows_keep_their_points_scores_and_styles_in_the_order_asked() -> None:
    taken = two().take([1, 0, 1])
    assert taken.kind.tolist() == [CROSSING, DIVIDER, CROSSING]
    assert [len(taken.polyline(i)) for i in range(3)] == [4, 3, 4]
    assert taken.polyline(1).tolist() == LINE and taken.score.tolist() == [0.9, 0.5, 0.9]
    assert taken.style[1].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert two().take(np.array([False, True])).polyline(0).tolist() == SQUARE
    assert len(two().take(np.zeros(2, bool))) == 0


def test_joined_tables_hold_the_elements_of_both_in_order() -> None:
    both = MapElements.cat([two(), MapElements.empty(), two().take([1])])
    assert both.offsets.tolist() == [0, 3, 7, 11]
    assert both.polyline(2).tolist() == SQUARE
    assert len(MapElements.cat([])) == 0


def test_a_turn_by_a_right_angle_and_a_step() -> None:
    moved = two().transform(10.0, 20.0, math.pi / 2)
    assert np.allclose(moved.polyline(0), [[10, 20], [6, 23], [0, 23]])
    assert moved.score.tolist() == two().score.tolist()


def test_segments_close_rings_and_leave_lines_open() -> None:
    start, end, owner = two().segments()
    assert list(zip(start.tolist(), end.tolist())) == [(0, 1), (1, 2), (3, 4), (4, 5), (5, 6), (6, 3)]
    assert owner.tolist() == [0, 0, 1, 1, 1, 1]


def test_the_columns_cannot_be_written_but_the_callers_array_can() -> None:
    mine = np.array(LINE)
    elements = MapElements.of([mine], DIVIDER)
    with pytest.raises(ValueError, match="read-only"):
        elements.points[0, 0] = 1.0
    mine[0, 0] = 7.0
    assert elements.points[0, 0] == 0.0


@pytest.mark.parametrize(
    ("column", "value", "message_match"),
    [
        ("kind", [0, 4], "0 to 3"),
        ("offsets", [0, 3, 6], "end at 7"),
        ("offsets", [0, 7], r"\(3,\)"),
        ("score", [1.0], r"score needs shape \(2,\)"),
        ("sigma", [1.0], r"sigma needs shape \(7,\)"),
        ("style", [[1.0, 0.0]] * 2, r"style needs shape \(2, 4\)"),
    ],
)
def test_columns_that_do_not_fit_are_refused_by_name(column: str, value: list, message_match: str) -> None:
    good = two()
    columns = {name: getattr(good, name) for name in ("kind", "offsets", "points", "score", "sigma", "style")}
    with pytest.raises(ShapeError, match=message_match):
        MapElements(**(columns | {column: np.asarray(value)}))


def test_polygons_hold_rings_as_columns() -> None:
    rings = Polygons.of([SQUARE, LINE])
    assert len(rings) == 2 and rings.ring(1).tolist() == LINE
    assert len(Polygons.of()) == 0
    with pytest.raises(ShapeError, match="start at 0"):
        Polygons(np.zeros((3, 2)), np.array([0, 2]))
