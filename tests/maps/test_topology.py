# SPDX-License-Identifier: Apache-2.0
"""Relations among lines, on a drawing:

0 ------->   2 ------->        0 and 2 lie on y = 0, a gap of 5 m between them; 1 and 3 lie 3.5 m to their left (y = 3.5)
1 ------->   3 ------->        4 leaves upwards where 3 ends, and 5 downwards: a branch of three ends
"""

from __future__ import annotations

import numpy as np

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.maps.fusion.topology import build_topology


def _line(x0, y0, x1, y1):
    return np.linspace((x0, y0), (x1, y1), 21)


def _drawing():
    lines = [
        _line(0, 0, 20, 0),
        _line(0, 3.5, 20, 3.5),
        _line(25, 0, 45, 0),
        _line(25, 3.5, 45, 3.5),
        _line(45.5, 4.0, 55, 14),
        _line(45.5, 3.0, 55, -14),
        np.array([[10.0, 1.0], [12.0, 1.0], [12.0, 2.0], [10.0, 2.0]]),
    ]
    return MapElements.of(lines, [DIVIDER] * 6 + [CROSSING])


def test_successors_continue_straight_ahead():
    pairs = build_topology(_drawing()).successor.tolist()
    assert [0, 2] in pairs and [1, 3] in pairs
    assert all(pair[0] not in (2, 4, 5) for pair in pairs)


def test_neighbours_have_sides():
    t = build_topology(_drawing())
    assert {(0, 1), (2, 3)} <= {tuple(p) for p in t.left.tolist()}
    assert {(1, 0), (3, 2)} <= {tuple(p) for p in t.right.tolist()}
    assert 6 not in np.concatenate((t.left, t.right))


def test_three_ends_are_a_branch():
    t = build_topology(_drawing())
    assert len(t.branch_xy) == 1 and np.hypot(*(t.branch_xy[0] - (45.3, 3.5))) < 0.3
    assert t.branch.tolist() == [[0, 3], [0, 4], [0, 5]]


def test_nothing_has_no_relations():
    t = build_topology(MapElements.empty())
    assert len(t.successor) == len(t.left) == len(t.branch) == 0
