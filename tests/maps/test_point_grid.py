# SPDX-License-Identifier: Apache-2.0
"""Points, their grid, and how many observations count."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.point_grid import (
    build_grid,
    cell_key,
    hash_coordinates,
    limit_observations,
    lower_bound,
    resample_lines,
)


def test_points_are_equally_spaced_with_unit_tangents():
    points = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0], [0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    first, xy, tangent, sigma = resample_lines(
        np.array([0, 3, 7]), points, np.linspace(0.1, 0.7, 7), np.array([False, True]), 1.0
    )
    assert first.tolist() == [0, 8, 24]
    assert np.allclose(np.hypot(*tangent.T), 1.0)
    line, ring = xy[:8], xy[8:]
    assert np.allclose(line[[0, 3, 7]], [[0, 0], [3, 0], [3, 4]]) and np.allclose(
        np.abs(np.diff(line, axis=0)).sum(1), 1
    )
    assert np.allclose(np.abs(np.diff(np.vstack((ring, ring[:1])), axis=0)).sum(1), 1)
    assert np.isclose(sigma[0], 0.1) and np.isclose(sigma[7], 0.3)


def test_an_element_without_length_has_no_points():
    first, xy, _, _ = resample_lines(np.array([0, 2]), np.ones((2, 2)), np.ones(2), np.array([False]), 1.0)
    assert first.tolist() == [0, 0] and len(xy) == 0


def test_a_cell_keeps_so_many_observations_and_agents_take_turns():
    # Four observations of agent 0 and two of agent 1 meet in cell 7; cell 8 has one of agent 0.
    observation = np.array([0, 0, 1, 2, 3, 4, 5, 0])
    key = np.array([7, 7, 7, 7, 7, 7, 7, 8])
    agent, rank = np.array([0, 0, 0, 0, 1, 1]), np.array([3, 0, 1, 2, 5, 4])
    kept = limit_observations(key, observation, agent, rank, 3)
    assert set(observation[kept & (key == 7)]) == {1, 5, 2}
    assert kept[7]
    assert limit_observations(key, observation, agent, rank, 6).all()


def test_the_grid_keeps_the_order_of_points_within_a_cell():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-20.0, 20.0, (300, 2))
    grid = build_grid(xy[:, 0], xy[:, 1], np.arange(300) % 2, 2.5)
    assert sorted(grid.order) == list(range(300))
    for begin, end in zip(grid.offsets[:-1], grid.offsets[1:]):
        rows = grid.order[begin:end]
        assert (np.diff(rows) > 0).all() and len(np.unique(np.floor(xy[rows] / 2.5), axis=0)) == 1
    assert [lower_bound(grid.keys, key) for key in grid.keys.tolist()] == list(range(len(grid.keys)))


def test_priorities_depend_on_coordinates_alone():
    xy = np.random.default_rng(1).normal(size=(1000, 2))
    priority = hash_coordinates(xy)
    assert (hash_coordinates(xy[::-1])[::-1] == priority).all() and len(np.unique(priority)) == 1000
    assert (hash_coordinates(np.array([[0.0, -0.0]])) == hash_coordinates(np.zeros((1, 2)))).all()
    assert abs(np.corrcoef(priority.astype(np.float64), xy[:, 0])[0, 1]) < 0.15


@pytest.mark.parametrize(("count", "extent_m"), [(0, 1.0), (1, 1.0), (5000, 20.0), (500, 1e6), (500, 5e8)])
def test_cells_are_sorted_stably_whatever_their_extent(count, extent_m):
    """The widest one has more pairs of cell and point than an integer can number."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-extent_m, extent_m, (2, count))
    kind = rng.integers(0, 4, count)
    grid, key = build_grid(x, y, kind, 1.0), cell_key(kind, x, y, 1.0)
    np.testing.assert_array_equal(grid.order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(grid.keys, np.unique(key))
    np.testing.assert_array_equal(np.diff(grid.offsets), np.unique(key, return_counts=True)[1])
