# SPDX-License-Identifier: Apache-2.0
"""Lanelet2 export as a graph: ``lanelet2.routing`` drives across a crossroads, changes lanes, and stops where it must."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DASHED, DIVIDER, DOUBLE, NO_STYLE, MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.lane_connections import connect_lanes
from manyeyes.maps.formats.lane_sections import build_lane_sections
from manyeyes.maps.formats.lanelet2_writer import write_lanelet2
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.topology import build_topology
from manyeyes.simulator.fleet import CROWDS, load_place, simulate_crowd

pytest.importorskip("shapely", reason="the map extra is not installed")
lanelet2 = pytest.importorskip("lanelet2", reason="the lanelet2 package is not installed")
# Arms of three lanes each way, 3.5 m wide, end 16.5 m from the middle; one drives on the right.
ARMS = {"west": (-1.0, 0.0), "east": (1.0, 0.0), "south": (0.0, -1.0), "north": (0.0, 1.0)}
LANES = (1.75, 5.25, 8.75)


class Routes:
    """A map as lanelet2 reads it back, with its routing graph for cars."""

    def __init__(self, vector_map, path):
        write_lanelet2(vector_map, path)
        origin = lanelet2.io.Origin(vector_map.frame.latitude, vector_map.frame.longitude)
        self.map, self.errors = lanelet2.io.loadRobust(str(path), lanelet2.projection.LocalCartesianProjector(origin))
        rules = lanelet2.traffic_rules.create(
            lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
        )
        self.graph = lanelet2.routing.RoutingGraph(self.map, rules)
        self.road = [one for one in self.map.laneletLayer if one.attributes["subtype"] == "road"]

    def at(self, x, y):
        """The road lanelet whose axis is nearest to a point."""
        return min(self.road, key=lambda one: np.hypot(*(axis(one) - (x, y)).T).min())

    def on_arm(self, arm, lane, inward, distance=60.0):
        """The lanelet of an arm that leads to the middle, or away from it, by its number from the middle of the road."""
        u = np.array(ARMS[arm]) * (-1.0 if inward else 1.0)
        right = np.array([u[1], -u[0]])
        return self.at(*(np.array(ARMS[arm]) * distance + LANES[lane] * right))


def axis(lanelet):
    return np.array([(p.x, p.y) for p in lanelet.centerline])


def outward(lanelet, arm):
    line = axis(lanelet)
    return float((line[-1] - line[0]) @ ARMS[arm]) > 0


def with_topology(elements, frame):
    return replace(VectorMap.of(elements, frame), topology=build_topology(elements))


@pytest.fixture(scope="module")
def crossroads(tmp_path_factory):
    place = load_place("cross")
    return Routes(with_topology(place.truth, place.frame), tmp_path_factory.mktemp("map") / "cross.osm")


def test_stop_lines_give_every_lane_of_a_crossroads_its_direction(crossroads):
    assert list(crossroads.errors) == [] and list(crossroads.graph.checkValidity()) == []
    for arm in ARMS:
        for lane in range(3):
            assert not outward(crossroads.on_arm(arm, lane, inward=True), arm)
            assert outward(crossroads.on_arm(arm, lane, inward=False), arm)
    assert all(one.attributes["one_way"] == "yes" for one in crossroads.road)


@pytest.mark.parametrize(
    ("start", "goal", "lane"),
    [("west", "east", 1), ("west", "north", 0), ("west", "south", 2), ("north", "south", 2), ("south", "west", 0)],
)
def test_a_route_leads_across_the_crossroads(crossroads, start, goal, lane):
    begin, end = (crossroads.on_arm(arm, lane, inward) for arm, inward in ((start, True), (goal, False)))
    path = list(crossroads.graph.shortestPath(begin, end))
    assert [one.id for one in (path[0], path[-1])] == [begin.id, end.id] and len(path) == 3
    driven = np.concatenate([axis(one) for one in path])
    step = np.hypot(*np.diff(driven, axis=0).T)
    # Over the ground of the junction, whose lanes end 16.5 m from the middle, in small steps.
    assert step.max() < 3.0 and np.hypot(*driven.T).min() < 16.5
    # Where two lanelets meet, the axis goes on without a jump.
    for one, other in pairwise(path):
        assert np.hypot(*(axis(one)[-1] - axis(other)[0])) < 0.01


def test_no_route_leads_against_the_traffic(crossroads):
    wrong, goal = crossroads.on_arm("west", 1, inward=False), crossroads.on_arm("east", 1, inward=False)
    assert crossroads.graph.shortestPath(wrong, goal) is None


def test_lanes_have_neighbours_and_every_inward_lane_a_successor(crossroads):
    graph = crossroads.graph
    for arm in ARMS:
        lanes = [crossroads.on_arm(arm, lane, inward=True) for lane in range(3)]
        assert all(graph.following(one) for one in lanes)
        # Dividers between lanes of one direction are dashed: a change is allowed. Across the double line it is not.
        assert graph.right(lanes[0]).id == lanes[1].id and graph.left(lanes[2]).id == lanes[1].id
        assert graph.left(lanes[0]) is None and graph.right(lanes[2]) is None


def test_stop_lines_and_crossings_are_regulatory_elements(crossroads):
    inward = crossroads.on_arm("west", 1, inward=True)
    (sign,) = inward.trafficSigns()
    (line,) = sign.refLines()
    assert [p.x for p in line] == pytest.approx([-17.5] * len(line), abs=0.01)
    crosswalks = [one for one in crossroads.map.laneletLayer if one.attributes["subtype"] == "crosswalk"]
    assert len(crosswalks) == 4
    for one in crosswalks:
        (rule,) = one.rightOfWay()
        assert [way.id for way in rule.rightOfWayLanelets()] == [one.id]
        assert len(rule.yieldLanelets()) >= 6
    assert not crossroads.on_arm("west", 1, inward=False).trafficSigns()


def test_a_fused_map_routes_too(tmp_path):
    place = load_place("cross")
    fused = fuse(simulate_crowd(place, 60, CROWDS["local"]).observations, frame=place.frame)
    routes = Routes(fused, tmp_path / "fused.osm")
    assert list(routes.errors) == [] and list(routes.graph.checkValidity()) == []
    begin, end = routes.on_arm("west", 1, inward=True, distance=40.0), routes.on_arm("east", 1, False, 40.0)
    path = routes.graph.shortestPath(begin, end)
    assert path is not None and np.hypot(*np.concatenate([axis(one) for one in path]).T).min() < 14


def straight(*sides, x=(0.0, 100.0)):
    return [np.stack((np.arange(x[0], x[1] + 1.0), np.full(int(x[1] - x[0]) + 1, side)), 1) for side in sides]


FRAME = MapFrame(48.0, 11.0)


def test_a_double_line_separates_directions_where_no_stop_line_does():
    lines = straight(7.0, 3.5, 0.0, -3.5, -7.0)
    kinds, styles = [BOUNDARY, *[DIVIDER] * 3, BOUNDARY], [NO_STYLE, DASHED, DOUBLE, DASHED, NO_STYLE]
    m = with_topology(MapElements.of(lines, kinds, style=styles), FRAME)
    for drives_on_right, sign in ((True, 1), (False, -1)):
        graph = build_lane_sections(m)
        connect_lanes(graph, m, drives_on_right)
        for section in graph.sections:
            middle = graph.middle_line(section)
            eastward = section.direction * np.sign(middle[-1, 0] - middle[0, 0])
            assert eastward == (-sign if middle[0, 1] > 0 else sign)


def test_a_gap_is_bridged_both_ways_where_nothing_gives_a_direction(tmp_path):
    lines = [*straight(3.5, 0.0, x=(0, 50)), *straight(3.7, 0.2, x=(60, 100))]
    m = with_topology(MapElements.of(lines, DIVIDER, style=DASHED), FRAME)
    routes = Routes(m, tmp_path / "gap.osm")
    assert len(routes.road) == 3 and {one.attributes["one_way"] for one in routes.road} == {"no"}
    west, east = routes.at(10, 1.75), routes.at(90, 1.9)
    assert len(list(routes.graph.shortestPath(west, east))) == 3
    assert len(list(routes.graph.shortestPath(east.invert(), west.invert()))) == 3


def test_a_line_is_cut_where_its_neighbour_ends():
    # The middle line goes on alone beside the upper one; the lower one ends and begins again 4 m on.
    lines = [*straight(3.5, 0.0), *straight(-3.5, x=(0, 40)), *straight(-3.6, x=(44, 80))]
    m = with_topology(MapElements.of(lines, DIVIDER, style=DASHED), FRAME)
    graph = build_lane_sections(m)
    lower = [s for s in graph.sections if graph.middle_line(s)[0, 1] < 0]
    upper = [s for s in graph.sections if graph.middle_line(s)[0, 1] > 0]
    assert len(lower) == 2 and len(upper) == 3
    lower.sort(key=lambda s: graph.middle_line(s)[0, 0])
    # The two ends of the lower line became one point, which both sections share.
    assert set(graph.ends(lower[0], True)) == set(graph.ends(lower[1], False))
    assert graph.middle_line(lower[1])[-1, 0] == pytest.approx(80, abs=1)
    # Each lower section has the piece above it in common with an upper one.
    assert {s.left for s in lower} < {s.right for s in upper}
