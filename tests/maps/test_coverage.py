# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from matplotlib.path import Path

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.fusion.coverage import cut_unobserved, find_cells_under_lines, find_observed_cells, merge_runs
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.observation_arrays import to_observation_arrays

EVERYWHERE = np.array([[row, -1000, 1000] for row in range(-1000, 1000)])


def make_observation(agent, at, lines, time_ns=0, view=((-20, -10), (20, -10), (20, 10), (-20, 10))):
    drawn = [np.asarray(line, dtype=np.float64) - at for line in lines]
    elements = MapElements.of(drawn, [DIVIDER] * len(drawn), [0.9] * len(drawn), [0.1] * sum(map(len, drawn)))
    return Observation(
        agent=agent,
        pass_id="a",
        time_ns=time_ns,
        pose=np.array([*at, 0.0]),
        covariance=np.diag([0.01, 0.01, 1e-4]),
        view=np.array(view, dtype=np.float64),
        elements=elements,
    )


def cells(runs):
    return {(x, row) for row, low, high in runs.tolist() for x in range(low, high + 1)}


@pytest.mark.parametrize("seed", range(4))
def test_runs_are_the_cells_whose_middle_a_view_holds(seed):
    rng = np.random.default_rng(seed)
    views, observations, pose = [], [], np.empty((5, 3))
    for k in range(5):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
        view = np.stack((np.cos(angle), np.sin(angle)), 1) * rng.uniform(4, 15, (7, 1))
        views.append(view)
        observations.append(make_observation(f"a{k}", np.zeros(2), [], k, view))
        pose[k] = *rng.uniform(-20, 20, 2), rng.uniform(-3, 3)
    runs = find_observed_cells(to_observation_arrays(observations, 1.0), pose)
    grid = np.stack(np.meshgrid(np.arange(-40, 40), np.arange(-40, 40)), -1).reshape(-1, 2)
    inside = np.zeros(len(grid), dtype=bool)
    for view, (x, y, yaw) in zip(views, pose):
        c, s = np.cos(yaw), np.sin(yaw)
        inside |= Path(view @ np.array([[c, s], [-s, c]]) + (x, y)).contains_points(grid + 0.5)
    assert cells(runs) == {tuple(cell) for cell in grid[inside].tolist()}
    assert np.array_equal(merge_runs(runs[::-1]), runs)


def test_the_ground_of_two_areas_is_that_of_both():
    arrays = to_observation_arrays([make_observation("a", np.array([3.0, 2.0]), [])], 1.0)
    pose = np.array([[3.0, 2.0, 0.4]])
    parts = [find_observed_cells(arrays, pose, area) for area in ((-50, -50, 5, 50), (5, -50, 50, 50))]
    assert all(len(part) for part in parts)
    assert np.array_equal(merge_runs(np.concatenate(parts)), find_observed_cells(arrays, pose))


def test_line_is_cut_in_unobserved_area():
    points, first = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [9.5, 0.5], [10.5, 0.5]]), np.array([0, 5])
    seen = np.zeros(5, dtype=bool)
    offsets, kept = cut_unobserved(points, first, seen, np.array([[0, 0, 2], [0, 9, 12]]))
    assert (offsets.tolist(), kept.tolist()) == ([0, 3, 5], [0, 1, 2, 3, 4])
    for runs in (np.array([[0, 0, 12]]), EVERYWHERE, np.zeros((0, 3), np.int64)):
        assert cut_unobserved(points, first, seen, runs)[0].tolist() == [0, 5]


def test_inferred_points_are_dropped_in_unobserved_area():
    points, first = np.stack((np.arange(8) + 0.5, np.full(8, 0.5)), 1), np.array([0, 8])
    inferred = np.arange(8) >= 3
    offsets, kept = cut_unobserved(points, first, inferred, np.array([[0, 0, 4], [0, 7, 9]]))
    assert (offsets.tolist(), kept.tolist()) == ([0, 5, 6], [0, 1, 2, 3, 4, 7])


def test_the_ground_under_lines():
    runs = find_cells_under_lines(np.array([[0.5, 0.5], [4.5, 0.5], [2.2, 5.5], [2.2, 6.5]]), np.array([0, 2, 4]))
    assert runs.tolist() == [[0, 0, 4], [5, 2, 2], [6, 2, 2]]
    assert find_cells_under_lines(np.zeros((0, 2)), np.zeros(1, np.int64)).shape == (0, 3)


@pytest.mark.parametrize(("gap", "parts"), [(5.0, 2), (-2.0, 1)])
def test_fused_lines_end_where_views_end(gap, parts):
    """Two agents look down one line; their views overlap, or five metres of it are in no view."""
    middles = (np.array([0.0, 0.0]), np.array([40.0 + gap, 0.0]))
    observations = [
        make_observation(f"{agent_number}{n}", at, [[(at[0] - 20, 1.0), (at[0] + 20, 1.0)]], 10 * agent_number + n)
        for agent_number, at in enumerate(middles)
        for n in range(3)
    ]
    elements = fuse(observations).select_published().elements
    assert len(elements) == parts
    ends = sorted(float(x) for k in range(parts) for x in elements.polyline(k)[[0, -1], 0])
    assert ends[0] == pytest.approx(-20, abs=1) and ends[-1] == pytest.approx(60 + gap, abs=1)
