# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from manyeyes.maps.formats.lanelet2 import Lanelet2Error, lanelet2_origin, read_lanelet2
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres

pytest.importorskip("shapely")
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "lanelet2" / "mapping_example.osm"
real = pytest.mark.skipif(not REAL.is_file(), reason="the Lanelet2 map is not in ../shared/data")
ORIGIN = (49.0, 8.4)


def osm(tmp_path, ways, lanelets, extra=""):
    """ways: name -> (points in metres, tags); lanelets: name -> (left, right, subtype). Equal points share a node."""
    nodes, lines = {}, []
    for name, (points, tags) in ways.items():
        refs = "".join(f'<nd ref="{nodes.setdefault(tuple(p), len(nodes) + 1)}"/>' for p in points)
        tag_lines = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
        lines.append(f'<way id="{name}">{refs}{tag_lines}</way>')
    degrees = degrees_from_metres(np.array(list(nodes), np.float64).reshape(-1, 2), ORIGIN)
    head = [f'<node id="{n}" lat="{a!r}" lon="{b!r}"/>' for n, (a, b) in zip(nodes.values(), degrees.tolist())]
    tail = [
        f'<relation id="{name}"><member type="way" ref="{left}" role="left"/><member type="way" ref="{right}" role="right"/>'
        f'<tag k="type" v="lanelet"/><tag k="subtype" v="{subtype}"/></relation>'
        for name, (left, right, subtype) in lanelets.items()
    ]
    path = tmp_path / "map.osm"
    path.write_text("<osm>" + "".join((*head, *lines, *tail)) + extra + "</osm>")
    return path


def test_two_lanelets_share_a_line_and_follow_each_other(tmp_path):
    # 11 and 12 follow each other towards +x; the way of 11's left border runs backwards in the file.
    ways = {
        1: ([(20, 4), (0, 4)], {"type": "line_thin", "subtype": "dashed"}),
        2: ([(0, 0), (10, 0), (20, 0)], {"type": "curbstone", "subtype": "high"}),
        3: ([(20, 4), (40, 4)], {"type": "line_thin", "subtype": "solid_solid"}),
        4: ([(20, 0), (40, 0)], {"type": "virtual"}),
        5: ([(38, 0), (38, 4)], {"type": "stop_line"}),
    }
    path = osm(tmp_path, ways, {11: (1, 2, "road"), 12: (3, 4, "road"), 13: (3, 4, "crosswalk")})
    network = read_lanelet2(path, ORIGIN)
    one, two = network.lanes
    np.testing.assert_allclose(one.left[[0, -1], :2], [[0, 4], [20, 4]], atol=1e-6)
    np.testing.assert_allclose(one.width_m, 4.0, atol=1e-6)
    assert one.successors == (1,) and two.predecessors == (0,) and one.kind == "driving"
    assert [(m.kind, round(float(m.line[0, 1]), 2)) for m in network.marks] == [
        ("broken", 4.0),
        ("curb", 0.0),
        ("solid", 4.12),
        ("solid", 3.88),
        ("stop", 0.0),
    ]
    assert len(network.crossings) == 1


def test_a_lanelet_whose_borders_both_run_backwards_is_turned_until_left_is_left(tmp_path):
    ways = {1: ([(20, 4), (0, 4)], {}), 2: ([(20, 0), (0, 0)], {})}
    (lane,) = read_lanelet2(osm(tmp_path, ways, {11: (1, 2, "road")}), ORIGIN).lanes
    np.testing.assert_allclose(lane.center[[0, -1], :2], [[0, 2], [20, 2]], atol=1e-6)


def test_lanelets_that_cross_are_a_junction_and_those_beside_each_other_are_none(tmp_path):
    ways = {
        1: ([(-20, 2), (20, 2)], {}),
        2: ([(-20, -2), (20, -2)], {}),
        3: ([(-2, -20), (-2, 20)], {}),
        4: ([(2, -20), (2, 20)], {}),
        5: ([(-20, 6), (20, 6)], {}),
    }
    path = osm(tmp_path, ways, {11: (1, 2, "road"), 12: (3, 4, "road")})
    assert [x.junction_id for x in read_lanelet2(path, ORIGIN).lanes] == ["11", "11"]
    path = osm(tmp_path, ways, {11: (1, 2, "road"), 12: (5, 1, "road"), 13: (2, 1, "road")})
    assert [x.junction_id for x in read_lanelet2(path, ORIGIN).lanes] == [None, None, None]


@pytest.mark.parametrize(
    ("ways", "extra", "text"),
    [
        ({1: ([(0, 0), (1, 1)], {})}, '<way id="9"><nd ref="777"/></way>', "names node 777"),
        ({1: ([(0, 0), (1, 1)], {})}, '<node id="8" lat="x" lon="1"/>', "'lat'"),
        ({1: ([(0, 0), (9, 0)], {}), 3: ([(0, 4), (9, 4)], {})}, "", "lanelet 11"),
    ],
)
def test_unreadable_files_are_named(tmp_path, ways, extra, text):
    lanelets = {11: (3, 2, "road")} if not extra else {}
    with pytest.raises(Lanelet2Error, match=text):
        read_lanelet2(osm(tmp_path, ways, lanelets, extra), ORIGIN)


def test_other_xml_is_no_map(tmp_path):
    (tmp_path / "a.osm").write_text("<gpx/>")
    with pytest.raises(Lanelet2Error, match="<osm>"):
        read_lanelet2(tmp_path / "a.osm")
    (tmp_path / "b.osm").write_text("<osm")
    with pytest.raises(Lanelet2Error, match="XML"):
        read_lanelet2(tmp_path / "b.osm")


@real
def test_the_real_map_lies_about_its_origin_with_lanes_of_plausible_width():
    network = read_lanelet2(REAL)
    latitude, longitude = lanelet2_origin(REAL)
    assert 48.9 < latitude < 49.1 and 8.3 < longitude < 8.6
    assert len(network.lanes) + len(network.crossings) == 371
    x0, y0, x1, y1 = network.bounds
    assert abs(x0 + x1) < 200 and abs(y0 + y1) < 200
    width = np.concatenate([x.width_m for x in network.lanes if x.is_drivable])
    assert 2.5 < np.percentile(width, 10) < np.percentile(width, 90) < 9.0
    linked = [(x, network.lanes[k]) for x in network.lanes for k in x.successors]
    assert len(linked) > 250
    assert max(np.linalg.norm(a.center[-1] - b.center[0]) for a, b in linked) < 0.01
