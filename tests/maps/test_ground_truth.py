# SPDX-License-Identifier: Apache-2.0
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE, STYLES, MapElements
from manyeyes.maps.formats.argoverse2_map import read_argoverse2_map
from manyeyes.maps.formats.opendrive import read_opendrive
from manyeyes.maps.roads.ground_truth import GroundTruthPolicy, build_ground_truth_map, cut_elements
from manyeyes.maps.roads.road_network import Crossing, Lane, RoadMark, RoadNetwork

shapely = pytest.importorskip("shapely")
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def line(*xy):
    return np.column_stack((np.array(xy, np.float64), np.zeros(len(xy))))


def straight(x0, x1, y, step=1.0):
    x = np.linspace(x0, x1, max(2, int(abs(x1 - x0) / step) + 1))
    return line(*zip(x, np.full(len(x), y)))


def mark(points, kind="solid", **fields):
    return RoadMark(points, kind, "white", 0.12, **fields)


def lane(number, x0, x1, y, junction=None, successors=(), predecessors=()):
    left, right = straight(x0, x1, y + 1.75), straight(x0, x1, y - 1.75)
    return Lane(
        number, "r", 0, -1, "driving", junction, 13.9, left, right, (left + right) / 2, predecessors, successors
    )


def network(marks=(), lanes=(), crossings=()):
    return RoadNetwork("test", (), tuple(lanes), tuple(marks), tuple(crossings), (), ())


def of(elements, kind):
    return elements.take(elements.kind == kind)


def test_a_line_stored_twice_is_one_also_where_the_copies_overlap_in_part():
    marks = [mark(straight(0, 60, 0.0)), mark(straight(80, 40, 0.1)), mark(straight(0, 80, 3.5))]
    truth = build_ground_truth_map(network(marks))
    assert len(truth) == 2
    np.testing.assert_allclose(truth.lengths(), 80.0, atol=1.1)


def test_lines_half_a_metre_apart_and_lines_that_cross_stay_two():
    assert len(build_ground_truth_map(network([mark(straight(0, 60, 0.0)), mark(straight(0, 60, 0.5))]))) == 2
    across = mark(line((30, -20), (30, 20)))
    truth = build_ground_truth_map(network([mark(straight(0, 60, 0.0)), across]))
    np.testing.assert_allclose(np.sort(truth.lengths()), [40.0, 60.0])


def test_pieces_are_chained_end_to_end_whatever_their_direction():
    marks = [mark(straight(0, 20, 0.0)), mark(straight(40, 20.3, 0.0)), mark(straight(40, 61, 0.0))]
    truth = build_ground_truth_map(network(marks))
    assert len(truth) == 1 and truth.lengths()[0] == pytest.approx(61.0, abs=0.01)
    np.testing.assert_allclose(truth.polyline(0)[[0, -1]], [[0, 0], [61, 0]])


@pytest.mark.parametrize("second", [straight(21.0, 40, 0.0), line((20.2, 0), (30, 5))])
def test_a_gap_or_a_bend_ends_a_line(second):
    assert len(build_ground_truth_map(network([mark(straight(0, 20, 0.0)), mark(second)]))) == 2


def test_at_a_fork_one_branch_continues_and_the_other_begins_where_they_part():
    fork = [mark(straight(0, 20, 0.0)), mark(line((20, 0), (40, 0.5))), mark(line((20, 0), (40, 3.2)))]
    lengths = np.sort(build_ground_truth_map(network(fork)).lengths())
    # The branches are 0.3 m apart 2.2 m behind the fork.
    np.testing.assert_allclose(lengths, [17.8, 40.2], atol=0.3)


def test_a_double_line_is_its_middle():
    where = {"road_id": "r", "section": 0, "lane_id": 0}
    pair = [mark(straight(0, 30, 0.12), **where), mark(straight(0, 30, -0.12), **where)]
    truth = build_ground_truth_map(network(pair))
    assert len(truth) == 1
    assert np.abs(truth.points[:, 1]).max() < 1e-9
    np.testing.assert_allclose(truth.style[0], np.eye(4)[STYLES.index("double")])


def test_style_is_shared_out_by_length_and_does_not_cut():
    truth = build_ground_truth_map(network([mark(straight(0, 30, 0.0), "broken"), mark(straight(30, 40, 0.0))]))
    assert len(truth) == 1
    np.testing.assert_allclose(truth.style[0], [0.25, 0.75, 0.0, 0.0], atol=1e-9)


def test_paint_inside_a_junction_is_dropped_and_an_edge_is_cut_there():
    lanes = [lane(0, 0, 40, 0), lane(1, 40, 60, 0, "j"), lane(2, 60, 100, 0)]
    marks = [mark(straight(0, 100, 1.75), "broken"), mark(straight(0, 100, -2.2), "curb")]
    truth = build_ground_truth_map(network(marks, lanes))
    dividers, edges = of(truth, DIVIDER), of(truth, BOUNDARY)
    # 0.3 m off the junction's ground, 1.5 m for the cut.
    np.testing.assert_allclose(dividers.points[dividers.offsets[1:] - 1, 0], [39.7, 100.0], atol=0.02)
    np.testing.assert_allclose(edges.points[edges.offsets[1:] - 1, 0], [38.5, 61.5, 100.0], atol=0.1)


def test_pavement_has_one_edge_on_each_side_and_none_where_the_map_ends():
    lanes = [lane(0, 0, 50, 0, successors=(1,)), lane(1, 50, 100, 0, predecessors=(0,)), lane(2, 0, 100, 3.5)]
    edges = of(build_ground_truth_map(network((), lanes), GroundTruthPolicy(boundary="pavement")), BOUNDARY)
    assert len(edges) == 2
    np.testing.assert_allclose(np.sort(edges.points[:, 1]), [-1.75, -1.75, 5.25, 5.25], atol=1e-6)
    assert edges.lengths().min() > 93


def test_the_policy_keeps_boundaries_whole_through_a_junction():
    lanes = [lane(0, 0, 40, 0), lane(1, 40, 60, 0, "j"), lane(2, 60, 100, 0)]
    marks = [mark(straight(0, 100, -2.2), "curb"), mark(straight(0, 100, 1.75), "broken")]
    truth = build_ground_truth_map(network(marks, lanes), GroundTruthPolicy(boundary_cut="none"))
    assert of(truth, BOUNDARY).lengths().tolist() == pytest.approx([100.0])
    assert of(truth, DIVIDER).lengths().max() < 41


def test_an_edge_far_from_any_lane_belongs_to_no_road():
    marks = [mark(straight(0, 40, -4.0), "curb"), mark(straight(0, 40, 40.0), "curb")]
    edges = build_ground_truth_map(network(marks, [lane(0, 0, 40, 0)]))
    assert len(edges) == 1 and np.allclose(edges.points[:, 1], -4.0)


def test_crossings_are_anticlockwise_rings_once_and_stop_lines_are_kept():
    ring = np.array([[0, 0, 0], [0, 8, 0], [3, 8, 0], [3, 0, 0]], np.float64)
    crossings = [Crossing(ring, "", ""), Crossing(ring[::-1] + [0.3, 0.2, 0], "", ""), Crossing(ring * 0.2, "", "")]
    truth = build_ground_truth_map(network([mark(line((10, 0), (10, 4)), "stop")], (), crossings))
    assert truth.kind.tolist() == [CROSSING, STOP_LINE]
    polygon = shapely.Polygon(truth.polyline(0))
    assert polygon.exterior.is_ccw and polygon.area == pytest.approx(24.0)
    np.testing.assert_allclose(truth.polyline(0)[0], truth.polyline(0)[np.lexsort(truth.polyline(0).T[::-1])[0]])


def test_the_order_of_a_file_does_not_matter():
    path = SHARED / "carla_opendrive" / "Town02.xodr.gz"
    if not path.is_file():
        pytest.skip("Town02 is not in ../shared/data")
    town = read_opendrive(path)
    policy = GroundTruthPolicy(boundary="pavement")
    expected = build_ground_truth_map(town, policy)
    mixed = dataclasses.replace(town, marks=town.marks[::-1], crossings=town.crossings[::-1])
    found = build_ground_truth_map(mixed, policy)
    np.testing.assert_array_equal(found.kind, expected.kind)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-9)


def test_a_real_map_holds_no_line_twice():
    logs = sorted(SHARED.glob("av2/*/map/log_map_archive_*.json"))
    if not logs:
        pytest.skip("no Argoverse 2 map in ../shared/data")
    for log in logs:
        truth = build_ground_truth_map(read_argoverse2_map(log))
        assert (truth.kind == DIVIDER).sum() >= 15 and (truth.kind == CROSSING).sum() >= 6
        for kind in (DIVIDER, BOUNDARY):
            lines = [shapely.LineString(p) for p in map(of(truth, kind).polyline, range((truth.kind == kind).sum()))]
            tree = shapely.STRtree(lines)
            for k, one in enumerate(lines):
                near = tree.query(one, predicate="dwithin", distance=0.1)
                others = shapely.union_all([lines[j].buffer(0.1) for j in near if j != k])
                assert one.intersection(others).length < max(2.0, 0.15 * one.length)


def test_an_empty_network_has_an_empty_truth():
    assert len(build_ground_truth_map(network())) == 0


def test_cutting_keeps_length_score_and_crossings():
    region = shapely.box(40, -10, 60, 10)
    ring = [(45, -5), (50, -5), (50, 20), (45, 20)]
    elements = MapElements.of(
        [[(0, 0), (100, 0)], [(30, 3), (42, 3)], ring], [DIVIDER, DIVIDER, CROSSING], [0.9, 0.8, 0.7]
    )
    cut = cut_elements(elements, region)
    # The second line's 2 m inside would be shorter than 5 m: it stays whole.
    np.testing.assert_allclose(cut.lengths(), [40.0, 20.0, 40.0, 12.0, 60.0])
    np.testing.assert_allclose(cut.score, [0.9, 0.9, 0.9, 0.8, 0.7])
    assert len(cut_elements(MapElements.empty(), region)) == 0


def test_a_closed_line_is_cut_at_the_region_and_not_where_it_began():
    angle = np.linspace(0, 2 * np.pi, 65)
    circle = 30 * np.stack((np.cos(angle), np.sin(angle)), 1)
    cut = cut_elements(MapElements.of([circle], [BOUNDARY]), shapely.box(-40, -40, -20, 40))
    assert len(cut) == 2
    assert cut.lengths().sum() == pytest.approx(2 * np.pi * 30, rel=2e-3)
