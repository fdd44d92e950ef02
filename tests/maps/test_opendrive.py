# SPDX-License-Identifier: Apache-2.0
"""OpenDRIVE against hand-made roads whose every point is known, and against the CARLA towns' known facts."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from manyeyes.maps.formats.opendrive import OpenDriveError, read_opendrive

TOWNS = Path(__file__).resolve().parents[3] / "shared" / "data" / "carla_opendrive"
needs_towns = pytest.mark.skipif(not TOWNS.is_dir(), reason=f"the CARLA towns are not at {TOWNS}")

LANE = """<lane id="{id}" type="{type}"><link>{link}</link><width sOffset="0" a="{width}" b="0" c="0" d="0"/>{mark}</lane>"""


def lane(id: int, type: str = "driving", width: float = 3.5, mark: str = "", link: str = "") -> str:
    return LANE.format(id=id, type=type, width=width, mark=mark, link=link)


def road(
    geometry: str,
    length: float,
    left: str = "",
    right: str = "",
    id: str = "1",
    extra: str = "",
    junction: str = "-1",
    center_mark: str = "",
    link: str = "",
    sections: str | None = None,
    offset: str = "",
) -> str:
    if sections is None:
        center = f'<center><lane id="0" type="none">{center_mark}</lane></center>'
        sections = f'<laneSection s="0"><left>{left}</left>{center}<right>{right}</right></laneSection>'
    return (
        f'<road id="{id}" length="{length}" junction="{junction}"><link>{link}</link><planView>{geometry}</planView>{extra}'
        f"<lanes>{offset}{sections}</lanes></road>"
    )


def geometry(shape: str, length: float, s: float = 0, x: float = 0, y: float = 0, heading: float = 0) -> str:
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{heading}" length="{length}">{shape}</geometry>'


def read(*roads: str, junctions: str = ""):
    return read_opendrive(f"<OpenDRIVE><header/>{''.join(roads)}{junctions}</OpenDRIVE>".encode(), "made")


def ends(shape: str, length: float) -> np.ndarray:
    """Last point of the reference line of one primitive from the origin along +x."""
    return read(road(geometry(shape, length), length, right=lane(-1))).roads[0].reference[-1]


def test_line_turned_and_moved():
    network = read(road(geometry("<line/>", 10, x=5, y=-2, heading=math.pi / 2), 10, right=lane(-1, width=4)))
    only = network.lanes[0]
    np.testing.assert_allclose(only.left[[0, -1]], [[5, -2, 0], [5, 8, 0]], atol=1e-9)
    np.testing.assert_allclose(only.right[[0, -1]], [[9, -2, 0], [9, 8, 0]], atol=1e-9)  # right of north is east
    assert only.length_m == pytest.approx(10)


def test_arc_is_a_circle():
    quarter = 20 * math.pi / 2
    np.testing.assert_allclose(ends('<arc curvature="0.05"/>', quarter), [20, 20, 0], atol=1e-9)
    np.testing.assert_allclose(ends('<arc curvature="-0.05"/>', quarter), [20, -20, 0], atol=1e-9)


def test_spiral_matches_fresnel_integrals():
    from scipy.special import fresnel

    length, end = 40.0, 0.05
    scale = math.sqrt(math.pi * length / end)
    s, c = fresnel(length / scale)
    wanted = [scale * c, scale * s, 0]
    np.testing.assert_allclose(ends(f'<spiral curvStart="0" curvEnd="{end}"/>', length), wanted, atol=1e-9)


def test_poly3_is_followed_by_arc_length():
    # v = u^2 / 100 up to u = 20 has a closed arc length.
    k = 2 / 100
    length = 20 / 2 * math.hypot(1, k * 20) + math.asinh(k * 20) / (2 * k)
    np.testing.assert_allclose(ends('<poly3 a="0" b="0" c="0.01" d="0"/>', length), [20, 4, 0], atol=1e-4)


@pytest.mark.parametrize(("ranged", "factor"), [("arcLength", 1.0), ("normalized", 25.0)])
def test_param_poly3(ranged: str, factor: float):
    shape = f'<paramPoly3 aU="0" bU="{factor}" cU="0" dU="0" aV="0" bV="0" cV="{0.01 * factor**2}" dV="0" pRange="{ranged}"/>'
    np.testing.assert_allclose(ends(shape, 25), [25, 6.25, 0], atol=1e-9)


def test_sampling_stays_on_the_curve():
    network = read(road(geometry('<arc curvature="0.1"/>', 30), 30, right=lane(-1)))
    line = network.roads[0].reference[:, :2]
    middle = (line[1:] + line[:-1]) / 2
    assert abs(np.linalg.norm(middle - [0, 10], axis=1) - 10).max() < 0.005


def test_elevation_and_superelevation_lift_the_lanes():
    extra = (
        '<elevationProfile><elevation s="0" a="1" b="0.1" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    )
    network = read(road(geometry("<line/>", 20), 20, left=lane(1, width=3), right=lane(-1, width=3), extra=extra))
    right = next(a for a in network.lanes if a.lane_id == -1)
    np.testing.assert_allclose(right.left[-1], [20, 0, 3], atol=1e-9)
    np.testing.assert_allclose(right.right[-1], [20, -3 * math.cos(0.1), 3 - 3 * math.sin(0.1)], atol=1e-9)


def test_neighbours_share_borders_and_lanes_run_with_their_traffic():
    network = read(road(geometry("<line/>", 10), 10, left=lane(1) + lane(2, "sidewalk", 2), right=lane(-1) + lane(-2)))
    by_id = {a.lane_id: a for a in network.lanes}
    assert (by_id[-1].center[-1] - by_id[-1].center[0])[0] == pytest.approx(10)
    assert (by_id[1].center[-1] - by_id[1].center[0])[0] == pytest.approx(-10)
    np.testing.assert_array_equal(by_id[-1].left, by_id[1].left[::-1])
    np.testing.assert_array_equal(by_id[-1].right, by_id[-2].left)
    np.testing.assert_array_equal(by_id[1].right, by_id[2].left)
    assert by_id[-1].left_neighbor == by_id[1].id
    assert by_id[-1].right_neighbor == by_id[-2].id
    assert by_id[1].left_neighbor == by_id[-1].id
    assert by_id[2].right_neighbor == -1
    # Left lies left of the way for every lane.
    for one in network.lanes:
        ahead, across = one.center[1] - one.center[0], one.left[0] - one.right[0]
        assert ahead[0] * across[1] - ahead[1] * across[0] > 0


def test_left_hand_traffic_swaps_directions():
    text = road(geometry("<line/>", 10), 10, right=lane(-1)).replace("<road ", '<road rule="LHT" ')
    only = read(text).lanes[0]
    assert (only.center[-1] - only.center[0])[0] == pytest.approx(-10)
    assert only.left[0, 1] < only.right[0, 1]


def test_lane_offset_jumps_at_a_section_without_moving_lanes():
    # The second section counts from the right border of what was lane -1: the drivable strip stays y in [-3.5, 0].
    center = '<center><lane id="0" type="none"/></center>'
    right = lane(-1, link='<successor id="1"/>')
    one = f'<laneSection s="0">{center}<right>{right}</right></laneSection>'
    two = f'<laneSection s="10"><left>{lane(1)}</left>{center}</laneSection>'
    offset = '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="10" a="-3.5" b="0" c="0" d="0"/>'
    network = read(road(geometry("<line/>", 20), 20, sections=one + two, offset=offset))
    for strip in network.lanes:
        both = np.concatenate((strip.left, strip.right))
        assert both[:, 1].min() == pytest.approx(-3.5)
        assert both[:, 1].max() == pytest.approx(0)


def test_marks_have_kind_colour_width_and_change_at_stated_offsets():
    mark = '<roadMark sOffset="0" type="{}" color="{}" width="0.2"/>'
    right = lane(
        -1, mark=mark.format("broken", "white") + '<roadMark sOffset="6" type="solid" color="white" width="0.15"/>'
    )
    curb = lane(-2, mark=mark.format("curb", "white"))
    network = read(
        road(geometry("<line/>", 10), 10, right=right + curb, center_mark=mark.format("solid broken", "yellow"))
    )
    kinds = [(m.kind, m.color, m.width_m, round(m.line[0, 1], 6)) for m in network.marks]
    # On the centre lane the first of a pair is the left one.
    assert kinds[:2] == [("solid", "yellow", 0.2, 0.2), ("broken", "yellow", 0.2, -0.2)]
    dashed, solid, edge = network.marks[2:]
    assert (dashed.kind, dashed.dash_m, dashed.gap_m) == ("broken", 3.0, 6.0)
    assert (dashed.line[0, 0], dashed.line[-1, 0]) == (0, pytest.approx(6))
    assert (solid.kind, solid.width_m, solid.line[0, 0], solid.line[-1, 0]) == ("solid", 0.15, pytest.approx(6), 10)
    assert (edge.kind, edge.is_paint, edge.lane_id) == ("curb", False, -2)


def test_dash_pattern_of_the_file_wins():
    line = '<type name="b" width="0.1"><line length="1.5" space="4.5" tOffset="0" sOffset="0"/></type>'
    mark = f'<roadMark sOffset="0" type="broken" color="white" width="0.1">{line}</roadMark>'
    only = read(road(geometry("<line/>", 10), 10, right=lane(-1, mark=mark))).marks[0]
    assert (only.dash_m, only.gap_m) == (1.5, 4.5)


def test_crossings_by_local_and_by_road_corners_agree():
    local = "".join(f'<cornerLocal u="{u}" v="{v}" z="0"/>' for u, v in ((4, 1), (4, -1), (-4, -1), (-4, 1), (4, 1)))
    by_road = "".join(f'<cornerRoad s="{s}" t="{t}" dz="0"/>' for s, t in ((9, 4), (11, 4), (11, -4), (9, -4)))
    objects = "".join(
        f'<object id="{k}" type="crosswalk" name="Ladder" s="10" t="0" hdg="{math.pi / 2}"><outline>{c}</outline></object>'
        for k, c in enumerate((local, by_road))
    )
    network = read(
        road(geometry("<line/>", 20, heading=0.7), 20, right=lane(-1), extra=f"<objects>{objects}</objects>")
    )
    one, two = (c.polygon for c in network.crossings)
    assert one.shape == two.shape == (4, 3)
    np.testing.assert_allclose(one, two, atol=1e-9)


def test_junction_connects_incoming_lane_to_its_successor():
    first = road(
        geometry("<line/>", 10), 10, right=lane(-1), id="1", link='<successor elementType="junction" elementId="9"/>'
    )
    turn = road(
        geometry('<arc curvature="0.1"/>', 5 * math.pi, x=10),
        5 * math.pi,
        right=lane(-1, link='<predecessor id="-1"/><successor id="-1"/>'),
        id="2",
        junction="9",
        link='<predecessor elementType="road" elementId="1" contactPoint="end"/>'
        '<successor elementType="road" elementId="3" contactPoint="start"/>',
    )
    last = road(geometry("<line/>", 10, x=20, y=10, heading=math.pi / 2), 10, right=lane(-1), id="3")
    connection = '<connection incomingRoad="1" connectingRoad="2" contactPoint="start"><laneLink from="-1" to="-1"/></connection>'
    network = read(first, turn, last, junctions=f'<junction id="9">{connection}</junction>')
    a, b, c = network.lanes
    assert (a.successors, b.predecessors, b.successors, c.predecessors) == ((1,), (0,), (2,), (1,))
    junction = network.junctions[0]
    assert (junction.lanes, junction.incoming) == ((1,), (0,))
    np.testing.assert_allclose(junction.center[:2], [15.0, 5.0], atol=2.0)


def test_height_is_read_from_the_lane_and_beside_it():
    extra = '<elevationProfile><elevation s="0" a="2" b="0.05" c="0" d="0"/></elevationProfile>'
    network = read(road(geometry("<line/>", 100), 100, left=lane(1), right=lane(-1), extra=extra))
    xy = np.array([[40.0, 1.0], [60.0, -2.0], [60.0, -30.0]])
    np.testing.assert_allclose(network.height(xy), [4, 5, 5], atol=1e-9)


def test_height_takes_the_level_that_is_asked_for():
    extra = '<elevationProfile><elevation s="0" a="6" b="0" c="0" d="0"/></elevationProfile>'
    below = road(geometry("<line/>", 40, x=-20), 40, left=lane(1), right=lane(-1))
    above = road(
        geometry("<line/>", 40, y=-20, heading=math.pi / 2), 40, left=lane(1), right=lane(-1), id="2", extra=extra
    )
    network, origin = read(below, above), np.zeros((1, 2))
    assert network.height(origin)[0] == pytest.approx(6)
    assert network.height(origin, near_z=0.5)[0] == pytest.approx(0)
    assert network.height(np.zeros((2, 2)), near_z=np.array([0.0, 5.0])).tolist() == pytest.approx([0, 6])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"not xml", "expected OpenDRIVE XML"),
        (gzip.compress(b"<OpenDRIVE/>", mtime=0)[:-6], "expected OpenDRIVE XML"),
        (b"<osm/>", "root element <OpenDRIVE>; got <osm>"),
        (b"<OpenDRIVE/>", "no <road>"),
        (
            b'<OpenDRIVE><road id="7" length="1"><planView/></road></OpenDRIVE>',
            "road 7: <planView> holds no <geometry>",
        ),
        (road(geometry("<circle/>", 5), 5).encode(), "it holds <circle>"),
        (road(geometry('<arc curvature="x"/>', 5), 5).encode(), "<arc> needs a number in 'curvature'; got 'x'"),
        (road(geometry("<line/>", 5), 5, sections="").encode(), "holds no <laneSection>"),
    ],
)
def test_errors_name_file_and_element(tmp_path: Path, data: bytes, message: str):
    path = tmp_path / "broken.xodr"
    path.write_bytes(data if data[:5] != b"<road" else b"<OpenDRIVE>" + data + b"</OpenDRIVE>")
    with pytest.raises(OpenDriveError) as error:
        read_opendrive(path)
    assert message in str(error.value)
    assert "broken.xodr" in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(OpenDriveError, match=r"absent\.xodr"):
        read_opendrive(tmp_path / "absent.xodr")


@pytest.mark.slow
@needs_towns
@pytest.mark.parametrize(
    ("town", "rise", "crossings"),
    [
        ("Town02", 0.0, 0),
        ("Town03", 9.4, 73),
        ("Town04", 11.0, 27),
        ("Town05", 10.0, 66),
        ("Town07", 10.1, 7),
        ("Town10HD", 0.0, 16),
    ],
)
def test_town_facts(town: str, rise: float, crossings: int):
    network = read_opendrive(TOWNS / f"{town}.xodr.gz")
    drivable = [a for a in network.lanes if a.is_drivable]
    z = np.concatenate([a.center[:, 2] for a in drivable])
    assert np.ptp(z) == pytest.approx(rise, abs=0.15)
    assert len(network.crossings) == crossings
    assert len(drivable) > 80
    gaps = [np.linalg.norm(a.center[-1] - network.lanes[k].center[0]) for a in drivable for k in a.successors]
    # One lane of Town03 merges sideways into its neighbour; every other link joins end to end.
    assert sum(gap > 0.03 for gap in gaps) == (1 if town == "Town03" else 0)
    assert sum(not a.successors for a in drivable) <= (12 if town == "Town03" else 0)
    for a in drivable:
        if a.right_neighbor >= 0:
            b = network.lanes[a.right_neighbor]
            edge = b.left if a.lane_id * b.lane_id > 0 else b.right[::-1]
            np.testing.assert_array_equal(a.right, edge)
