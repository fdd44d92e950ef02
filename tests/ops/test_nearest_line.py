# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.ops.nearest_line import find_nearest_line, find_nearest_line_slow, segments_of


def columns(*lines):
    first = np.concatenate(([0], np.cumsum([len(line) for line in lines]))).astype(np.int64)
    return np.concatenate([np.asarray(line, dtype=np.float64) for line in lines]), first


def test_segments_know_their_lines_and_empty_lines_have_none() -> None:
    line, start = segments_of(np.array([0, 3, 4, 4, 6]))
    assert line.tolist() == [0, 0, 3] and start.tolist() == [0, 1, 4]


def test_two_streets_by_hand() -> None:
    points, first = columns([(0, 0), (10, 0)], [(0, 3), (0, 13)])
    got = find_nearest_line(np.array([[5.0, 1.0], [1.0, 8.0], [13.0, 4.0], [99.0, 99.0]]), points, first, 5.0)
    assert got.distance.tolist() == pytest.approx([1.0, 1.0, 5.0, np.inf])
    assert got.line.tolist() == [0, 1, 0, -1]
    assert got.heading[:2].tolist() == pytest.approx([0.0, np.pi / 2])
    assert got.lateral_m.tolist() == pytest.approx([1.0, -1.0, 4.0, np.inf]), "3 m beyond the end and 4 m beside it"


def test_no_lines_and_no_queries() -> None:
    points, first = columns([(0, 0), (1, 0)])
    assert find_nearest_line(np.zeros((0, 2)), points, first, 1.0).distance.shape == (0,)
    empty = find_nearest_line(np.zeros((2, 2)), np.zeros((0, 2)), np.array([0]), 1.0)
    assert empty.line.tolist() == [-1, -1] and np.isinf(empty.distance).all()


@given(seed=st.integers(0, 10**6), reach=st.sampled_from([0.2, 1.0, 4.0, 30.0]))
def test_the_grid_equals_the_reference(seed: int, reach: float) -> None:
    draw = np.random.default_rng(seed)
    lines = [draw.uniform(-20, 20, 2) + draw.normal(0, 4, (draw.integers(1, 7), 2)).cumsum(0) for _ in range(6)]
    points, first = columns(*lines)
    queries = np.vstack((draw.uniform(-40, 40, (30, 2)), points + draw.normal(0, 0.5, points.shape)))
    fast, slow = find_nearest_line(queries, points, first, reach), find_nearest_line_slow(queries, points, first, reach)
    np.testing.assert_allclose(fast.distance, slow.distance, atol=1e-12)
    np.testing.assert_array_equal(fast.line, slow.line)
    np.testing.assert_allclose(fast.heading, slow.heading, atol=1e-12)
    np.testing.assert_allclose(fast.lateral_m, slow.lateral_m, atol=1e-9)
