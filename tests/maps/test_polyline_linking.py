# SPDX-License-Identifier: Apache-2.0
"""Which stations become one line: rows of stations 1 m apart along x, small enough to count by hand."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.polyline_linking import link_stations


def count_chains(rows, coverage=3.0, dashed=False):
    """How many lines rows of (first x, last x, y) become."""
    parts = [np.stack((np.arange(a, b + 0.5), np.full(int(b - a) + 1, y)), 1) for a, b, y in rows]
    xy = np.concatenate(parts)
    count = len(xy)
    tangent = np.tile([1.0, 0.0], (count, 1))
    every = np.full(count, coverage)
    first, members = link_stations(
        xy, tangent, np.zeros(count, np.int64), np.ones(count), np.full(count, dashed), every
    )
    assert sorted(members.tolist()) == list(range(count))
    return len(first) - 1


def test_stations_in_a_row_are_one_line_and_rows_a_lane_apart_are_two():
    assert count_chains([(0.0, 30.0, 0.0)]) == 1
    assert count_chains([(0.0, 30.0, 0.0), (0.0, 30.0, 3.5)]) == 2
    assert count_chains([(0.0, 30.0, 0.0), (31.0, 60.0, 3.5)]) == 2


@pytest.mark.parametrize(
    ("neighbour", "chains"),
    [
        ([(0.0, 80.0, 3.5)], 2),
        ([(0.0, 30.0, 3.5), (50.0, 80.0, 3.5)], 4),
        ([(0.0, 30.0, 9.0), (50.0, 80.0, 9.0)], 2),
    ],
    ids=["the neighbour runs on", "it ends, too", "no neighbour is near"],
)
def test_a_line_is_not_joined_across_ground_where_its_neighbours_end_too(neighbour, chains):
    assert count_chains([(0.0, 30.0, 0.0), (50.0, 80.0, 0.0), *neighbour], 3.0) == chains


@pytest.mark.parametrize("gap, coverage, dashed, lines", [
    (8.0, 99.0, False, 1),
    (10.0, 99.0, False, 2),  # high coverage without a detection
    (10.0, 99.0, True, 1),
    (20.0, 99.0, True, 2),
    (20.0, 3.0, False, 1),  # low coverage
    (30.0, 3.0, False, 2),
])  # fmt: skip
def test_gap_is_bridged_at_low_coverage(gap, coverage, dashed, lines):
    assert count_chains([(0.0, 30.0, 0.0), (30.0 + gap, 60.0 + gap, 0.0)], coverage, dashed) == lines


@pytest.mark.parametrize("aside, lines", [(0.9, 1), (1.2, 2)])
def test_ends_may_lie_farther_aside_than_neighbours(aside, lines):
    assert count_chains([(0.0, 30.0, 0.0), (35.0, 65.0, aside)]) == lines  # 0.8 m and 0.04 a metre of gap
