# SPDX-License-Identifier: Apache-2.0
"""The generated places of other shapes: lanes on paved ground, truth cut as any map is, and what is particular to each shape."""

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE
from manyeyes.maps.roads.ground_truth import cut_elements
from manyeyes.simulator.fleet import CROWDS, load_place, simulate_crowd
from manyeyes.simulator.fleet.generated_roads import HALF_SIZE_M, make_merge, make_roundabout, road_truth

shapely = pytest.importorskip("shapely")

both = pytest.mark.parametrize("make", [make_roundabout, make_merge])


def lines_of(truth, kind):
    rows = np.flatnonzero(truth.kind == kind)
    return [shapely.LineString(truth.polyline(row)) for row in rows]


def successors(routes, lane):
    return routes.successor[routes.successor_offsets[lane] : routes.successor_offsets[lane + 1]].tolist()


@both
def test_lanes_lie_on_paved_ground_and_clear_of_its_edges(make):
    layout = make()
    inside = layout.routes.points[np.abs(layout.routes.points).max(1) < HALF_SIZE_M]
    points = shapely.points(inside)
    assert shapely.contains(layout.pavement, points).all()
    assert shapely.distance(points, layout.pavement.boundary).min() > 1.2


@both
def test_a_lane_begins_where_its_predecessor_ends_and_in_its_direction(make):
    routes = make().routes
    pairs = [(routes.lane(i), routes.lane(k)) for i in range(len(routes)) for k in successors(routes, i)]
    assert len(pairs) > 30
    assert max(np.linalg.norm(one[-1] - other[0]) for one, other in pairs) < 1e-6
    turns = []
    for one, other in pairs:
        u, v = one[-1] - one[-2], other[1] - other[0]
        turns.append(abs(np.arctan2(u[0] * v[1] - u[1] * v[0], u @ v)))
    assert max(turns) < 0.15


@both
def test_a_lane_without_successor_leaves_the_place(make):
    routes = make().routes
    ends = np.array([routes.lane(i)[-1] for i in range(len(routes)) if not successors(routes, i)])
    assert len(ends) >= 4
    assert (np.abs(ends).max(1) > HALF_SIZE_M).all()


@both
def test_the_truth_is_cut_as_any_map_is(make):
    layout = make()
    truth = road_truth(layout)
    again = cut_elements(truth, layout.ground, 2.0)
    assert np.bincount(again.kind).tolist() == np.bincount(truth.kind).tolist()
    assert set(truth.kind) == {DIVIDER, BOUNDARY, CROSSING, STOP_LINE}
    on_ground = shapely.MultiLineString(lines_of(truth, DIVIDER)).intersection(layout.ground)
    assert on_ground.length < 0.1


@both
def test_edges_join_and_end_only_at_the_border_of_the_truth(make):
    edges = lines_of(road_truth(make()), BOUNDARY)
    ends = np.array([shapely.get_coordinates(line)[[0, -1]] for line in edges]).reshape(-1, 2)
    inner = ends[np.abs(ends).max(1) < HALF_SIZE_M - 0.01]
    assert len(inner) > 8
    for end in inner:
        assert np.sum(np.linalg.norm(ends - end, axis=1) < 0.05) == 2


def test_the_ring_of_the_roundabout_is_a_circle_between_its_arms():
    lines = lines_of(road_truth(make_roundabout()), DIVIDER)
    ring = [line for line in lines if line.distance(shapely.Point(0, 0)) < 30.0]
    assert len(ring) == 4
    radius = np.linalg.norm(np.concatenate([shapely.get_coordinates(line) for line in ring]), axis=1)
    np.testing.assert_allclose(radius, 28.0, atol=0.02)
    # A mouth spans the arm and its rounded corners of 8 m, whose middles lie 40 m from that of the ring, and 0.04 rad on each side.
    mouths = 4 * (np.arcsin((2 * 3.5 + 8) / 40) + np.arcsin((3.5 + 8) / 40) + 2 * 0.04)
    assert sum(line.length for line in ring) / 28.0 == pytest.approx(2 * np.pi - mouths, abs=0.01)


@pytest.mark.parametrize(("x", "dividers"), [(-100.0, 3), (-20.0, 5), (45.0, 3)])
def test_the_merging_and_the_splitting_lane_add_lines(x, dividers):
    r"""Seen from above, the road runs west to east; its edges widen by a lane each between the ramps' noses and their ends.

    \                      ________
     \____________________/            splits off
    _______________________________
    _______________________________
    _____________________
     ____________________\_________    merges
    /
    """
    truth = road_truth(make_merge())
    section = shapely.LineString([(x, -32.0), (x, 28.0)])
    assert sum(line.crosses(section) for line in lines_of(truth, DIVIDER)) == dividers


def test_the_ramp_that_splits_off_becomes_two_lanes():
    layout = make_merge()
    section = shapely.LineString([(-140.0, 40.0), (-118.0, 66.0)])
    assert len(lines_of(road_truth(layout), DIVIDER)) == 11
    fork = [i for i in range(len(layout.routes)) if len(successors(layout.routes, i)) == 2]
    assert len(fork) >= 2
    assert layout.pavement.intersection(section).length > 7.0


@pytest.mark.parametrize("name", ["roundabout", "merge"])
def test_a_perfect_crowd_reports_the_truth(name):
    place = load_place(name)
    crowd = simulate_crowd(place, 12, CROWDS["perfect"])
    shapes = [shapely.LineString(place.truth.polyline(row)) for row in range(len(place.truth))]
    assert len(crowd) == 12
    assert (crowd.origin >= 0).all()
    for k, observation in enumerate(crowd.observations):
        own = observation.elements_in_map(crowd.true_poses[k])
        origin = crowd.origin[crowd.origin_offsets[k] : crowd.origin_offsets[k + 1]]
        for row in np.flatnonzero(own.kind != CROSSING):
            assert shapely.distance(shapely.points(own.polyline(int(row))), shapes[origin[row]]).max() < 0.3
