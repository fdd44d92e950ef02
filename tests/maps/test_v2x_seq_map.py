# SPDX-License-Identifier: Apache-2.0
"""V2X-Seq's maps: a road of two lanes each way, drawn by hand in the file's own words."""

import json

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, STOP_LINE
from manyeyes.maps.formats.v2x_seq_map import V2xSeqMapError, read_v2x_seq_map
from manyeyes.maps.roads.ground_truth import build_ground_truth_map

pytest.importorskip("shapely")


def format_points(*points):
    return [f"({x}, {y})" for x, y in points]


def lane(low, high, y_left, y_right, **fields):
    """From x = low to high (backwards where low is greater), its borders at these y."""
    base = {
        "left_boundary": format_points((low, y_left), (high, y_left)),
        "right_boundary": format_points((low, y_right), (high, y_right)),
    }
    return {**base, "lane_type": "CITY_DRIVING", **fields}


def road(begin, end, name):
    """Two lanes towards +x below y = 0, two back above; neighbours store the line between them twice, 10 cm apart."""
    return {
        f"{name}-1": lane(begin, end, -3.5, -7.0),
        f"{name}-2": lane(begin, end, 0.0, -3.4),
        f"{name}-3": lane(end, begin, 0.1, 3.5),
        f"{name}-4": lane(end, begin, 3.5, 7.0, lane_type="BIKING"),
    }


def crossing_map():
    """Two such roads, and a junction between them from x = 60 to 80, whose lanes have unpainted borders."""
    inner = {"j-1": lane(60, 80, 0.0, -3.5), "j-2": lane(80, 60, 0.0, 3.5, is_intersection="True")}
    bare = {"no-borders": {"lane_type": "CITY_DRIVING", "left_boundary": []}}
    return {
        "LANE": {**road(0, 60, "a"), **road(80, 140, "b"), **inner, **bare},
        "JUNCTION": {"7": {"polygon": format_points((60, -8), (80, -8), (80, 8), (60, 8))}},
        "CROSSWALK": {"3": {"polygon": format_points((54, -7), (58, -7), (58, 7), (54, 7))}},
        "STOPLINE": {"5": {"centerline": format_points((52, -7), (52, 0))}},
    }


def write(tmp_path, root):
    path = tmp_path / "yizhuang06.json"
    path.write_text(json.dumps(root))
    return path


def of_kind(truth, kind):
    return [truth.polyline(k) for k in np.flatnonzero(truth.kind == kind)]


def test_lines_between_lanes_are_dividers_and_outer_ones_edges_each_once(tmp_path):
    truth = build_ground_truth_map(read_v2x_seq_map(write(tmp_path, crossing_map())))
    dividers, edges = of_kind(truth, DIVIDER), of_kind(truth, BOUNDARY)
    # Three lines between four lanes, each one of the two that are stored, and two edges; on either side of the junction.
    for lines, heights in ((dividers, (-3.45, 0.05, 3.5)), (edges, (-7.0, 7.0))):
        for right in (False, True):
            here = sorted(float(line[:, 1].mean()) for line in lines if (line[:, 0].min() > 70) == right)
            assert here == pytest.approx(heights, abs=0.051)
    assert all(55 < np.ptp(line[:, 0]) <= 60.5 for line in (*dividers, *edges))
    (ring,) = of_kind(truth, CROSSING)
    assert (ring[:, 0].min(), ring[:, 0].max(), ring[:, 1].min(), ring[:, 1].max()) == (54, 58, -7, 7)
    (stop,) = of_kind(truth, STOP_LINE)
    np.testing.assert_allclose(stop[:, 0], 52)


def test_lanes_know_their_junction_kind_and_successors(tmp_path):
    root = crossing_map()
    root["LANE"]["a-2"]["successors"] = ["j-1", "gone"]
    network = read_v2x_seq_map(write(tmp_path, root), offset_xy=(1000.0, -10.0))
    by_name = {one.road_id: one for one in network.lanes}
    assert "no-borders" not in by_name and network.name == "yizhuang06"
    assert [by_name[name].junction_id for name in ("a-1", "j-1", "j-2")] == [None, "7", "7"]
    assert by_name["a-2"].successors == (by_name["j-1"].id,) and by_name["j-1"].predecessors == (by_name["a-2"].id,)
    assert by_name["a-4"].kind == "biking" and not by_name["a-4"].is_drivable
    np.testing.assert_allclose(by_name["a-1"].left[0, :2], [1000.0, -13.5])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: root.pop("LANE"), "'LANE'"),
        (lambda root: root["LANE"]["a-1"].update(left_boundary=["(1, 2)", "(1"]), "LANE a-1 field 'left_boundary'"),
        (lambda root: root["LANE"]["a-1"].update(left_boundary=["(1, 2)"]), "2 or more finite points; got 1"),
        (lambda root: root["CROSSWALK"]["3"].pop("polygon"), "CROSSWALK 3 field 'polygon'"),
        (lambda root: root.update(JUNCTION=[1]), "'JUNCTION'"),
    ],
    ids=["no lanes", "half a point", "one point", "no polygon", "a list"],
)
def test_bad_files_name_file_element_and_field(tmp_path, spoil, message):
    root = crossing_map()
    spoil(root)
    with pytest.raises(V2xSeqMapError, match=message) as caught:
        read_v2x_seq_map(write(tmp_path, root))
    assert "yizhuang06.json" in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(V2xSeqMapError, match=r"nowhere\.json"):
        read_v2x_seq_map(tmp_path / "nowhere.json")
