# SPDX-License-Identifier: Apache-2.0
"""Read a Lanelet2 map (OSM XML) into a RoadNetwork.

Sources: the tag lists of Lanelet2's documentation (LinestringTagging, LaneletAndAreaTagging). Degrees become metres by a
transverse Mercator with scale 1 about an origin (:mod:`manyeyes.maps.roads.transverse_mercator`): the one given, else the middle of
the nodes' bounding box rounded to 1e-4 degrees. Nodes that carry ``local_x`` and ``local_y`` keep degrees: those tags have no
frame of their own.

Paint is line_thin and line_thick (subtype solid, dashed and their pairs; without a subtype solid); edges are curbstone,
road_border and guard_rail; stop_line is a stop line; lanelets of subtype crosswalk are crossings. virtual, wall, fence and
symbols are no part of a road's surface and are left out. The file names no junctions: lanelets that follow or precede more
than one lanelet, or that overlap others, and that lie in one patch of ground form one.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import MAX_TEXT_BYTES, read_file
from manyeyes.datatypes import ManyeyesError, MissingExtraError
from manyeyes.maps.roads.lane_links import build_junctions, complete_lane_links, connected_components, resample_borders
from manyeyes.maps.roads.road_network import Crossing, Lane, RoadMark, RoadNetwork
from manyeyes.maps.roads.transverse_mercator import metres_from_degrees

Array = NDArray[np.float64]

_KIND_OF_SUBTYPE = {
    "road": "driving",
    "highway": "driving",
    "play_street": "driving",
    "exit": "driving",
    "emergency_lane": "shoulder",
    "bus_lane": "bus",
    "bicycle_lane": "biking",
    "walkway": "walking",
    "shared_walkway": "walking",
}
_EDGES = ("curbstone", "road_border", "guard_rail")
_PAINT = ("line_thin", "line_thick")
_WIDTH_M = {"line_thin": 0.12, "line_thick": 0.25, "stop_line": 0.4}
_DASH_M, _GAP_M = 3.0, 6.0
_SPEED_MPS = 13.9
_MIN_OVERLAP_M2 = 2.0


class Lanelet2Error(ManyeyesError):
    """A Lanelet2 file that cannot be read; the text names the file and the element."""


@dataclass(frozen=True, eq=False)
class _OsmWay:
    """A linestring: points (M, 3), ids of its two end nodes, its tags."""

    points: Array
    ends: tuple[str, str]
    tags: dict[str, str]


def read_lanelet2(source: Path | str, origin: tuple[float, float] | None = None) -> RoadNetwork:
    """Return the roads of an OSM file; origin: latitude and longitude, degrees, of the frame's zero (see
    :func:`lanelet2_origin`).
    """
    path = Path(source)
    root = _root(path)
    origin = origin or _middle(root, path)
    ways = _ways(root, path, origin)
    lanes, crossings = _lanelets(root, path, ways)
    marks = [mark for name in sorted(ways, key=int) for mark in _marks(ways[name], name)]
    return RoadNetwork(path.stem, (), lanes, tuple(marks), crossings, (), build_junctions(lanes))


def lanelet2_origin(source: Path | str) -> tuple[float, float]:
    """Return the origin that :func:`read_lanelet2` takes when none is given: latitude, longitude in degrees."""
    path = Path(source)
    return _middle(_root(path), path)


def _root(path: Path) -> ET.Element:
    try:
        root = ET.fromstring(read_file(path, MAX_TEXT_BYTES))
    except (OSError, ET.ParseError) as error:
        raise Lanelet2Error(f"{path}: expected Lanelet2's OSM XML; {error}.") from error
    if root.tag != "osm":
        raise Lanelet2Error(f"{path}: expected the root element <osm>; got <{root.tag}>.")
    return root


def _number(element: ET.Element, field: str, path: Path) -> float:
    try:
        value = float(element.get(field, "nan"))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Lanelet2Error(
            f"{path}: <{element.tag}> {element.get('id')} needs a number in '{field}'; got {element.get(field)!r}."
        )
    return value


def _middle(root: ET.Element, path: Path) -> tuple[float, float]:
    nodes = root.findall("node")
    if not nodes:
        raise Lanelet2Error(f"{path}: no <node> elements; the file holds no map.")
    places = np.array([[_number(node, "lat", path), _number(node, "lon", path)] for node in nodes])
    latitude, longitude = ((places.min(0) + places.max(0)) / 2).round(4).tolist()
    return latitude, longitude


def _tags(element: ET.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.findall("tag")}


def _ways(root: ET.Element, path: Path, origin: tuple[float, float]) -> dict[str, _OsmWay]:
    """Return all linestrings of two or more different points, in metres."""
    nodes = [node for node in root.findall("node") if node.get("action") != "delete"]
    names = [node.get("id", "") for node in nodes]
    degrees = np.array([[_number(node, "lat", path), _number(node, "lon", path)] for node in nodes]).reshape(-1, 2)
    height = [float(_tags(node).get("ele", 0.0)) for node in nodes]
    xyz = np.column_stack((metres_from_degrees(degrees[:, 0], degrees[:, 1], origin), height))
    place = {name: k for k, name in enumerate(names)}
    ways = {}
    for way in root.findall("way"):
        members = [member.get("ref", "") for member in way.findall("nd")]
        missing = next((m for m in members if m not in place), None)
        if missing is not None:
            raise Lanelet2Error(f"{path}: <way> {way.get('id')} names node {missing}, which the file does not hold.")
        points = xyz[[place[m] for m in members]]
        fresh = np.concatenate(([True], np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) > 1e-3))
        if fresh.sum() >= 2:
            ways[way.get("id", "")] = _OsmWay(points[fresh], (members[0], members[-1]), _tags(way))
    return ways


def _marks(way: _OsmWay, name: str) -> list[RoadMark]:
    """Return the paint or the edge that a linestring is; nothing for virtual ones and symbols."""
    kind, subtype = way.tags.get("type", ""), way.tags.get("subtype", "")
    color = way.tags.get("color", "white")
    if kind in _EDGES:
        return [RoadMark(way.points, "curb", color, 0.0)]
    if kind == "stop_line":
        return [RoadMark(way.points, "stop", color, _WIDTH_M[kind])]
    if kind not in _PAINT:
        return []
    strokes = [word for word in subtype.split("_") if word in ("solid", "dashed")] or ["solid"]
    width = _WIDTH_M[kind]
    step = np.gradient(way.points[:, :2], axis=0)
    normal = np.stack((-step[:, 1], step[:, 0]), 1) / np.maximum(np.linalg.norm(step, axis=1), 1e-9)[:, None]
    marks = []
    for stroke, offset in zip(strokes, [0.0] if len(strokes) == 1 else [width, -width]):
        line = way.points.copy()
        line[:, :2] += offset * normal
        dash, gap = (_DASH_M, _GAP_M) if stroke == "dashed" else (0.0, 0.0)
        marks.append(RoadMark(line, "broken" if dash else "solid", color, width, dash, gap, f"way {name}"))
    return marks


def _lanelets(root: ET.Element, path: Path, ways: dict[str, _OsmWay]) -> tuple[tuple[Lane, ...], tuple[Crossing, ...]]:
    """Return lanes in the order of their ids, linked and grouped into junctions, and crossings."""
    lanes: list[Lane] = []
    crossings: list[Crossing] = []
    ends: list[tuple[tuple[str, str], tuple[str, str]]] = []
    for relation in sorted(root.findall("relation"), key=lambda r: int(r.get("id", "0"))):
        tags = _tags(relation)
        if tags.get("type") != "lanelet":
            continue
        context = f"{path}: lanelet {relation.get('id')}"
        left, left_ends = _border(relation, "left", ways, context)
        right, right_ends = _border(relation, "right", ways, context)
        left, right, left_ends, right_ends = _align_borders(left, right, left_ends, right_ends)
        if tags.get("subtype") == "crosswalk":
            crossings.append(Crossing(np.concatenate((left, right[::-1])), "", "crosswalk"))
            continue
        kind = _KIND_OF_SUBTYPE.get(tags.get("subtype", ""), "none")
        left, right = resample_borders(left, right)
        number, name = len(lanes), str(relation.get("id"))
        lanes.append(Lane(number, name, 0, -1, kind, None, _SPEED_MPS, left, right, (left + right) / 2))
        ends.append(((left_ends[0], right_ends[0]), (left_ends[1], right_ends[1])))
    starts: dict[tuple[str, str], list[int]] = {}
    for k, (begin, _) in enumerate(ends):
        starts.setdefault(begin, []).append(k)
    linked = [replace(lane, successors=tuple(starts.get(end, ()))) for lane, (_, end) in zip(lanes, ends)]
    linked = complete_lane_links(linked)
    names = _junctions(linked)
    return tuple(replace(lane, junction_id=name) for lane, name in zip(linked, names)), tuple(crossings)


def _border(relation: ET.Element, role: str, ways: dict[str, _OsmWay], context: str) -> tuple[Array, tuple[str, str]]:
    """Return one border of a lanelet: its ways of a role, joined where they share a node."""
    members = [m.get("ref", "") for m in relation.findall("member") if m.get("role") == role and m.get("type") == "way"]
    missing = [m for m in members if m not in ways]
    if not members or missing:
        got = f"the unknown way {missing[0]}" if missing else "none"
        raise Lanelet2Error(f"{context}: expected member ways with the role '{role}'; got {got}.")
    points, ends = ways[members[0]].points, ways[members[0]].ends
    for name in members[1:]:
        other, other_ends = ways[name].points, ways[name].ends
        if ends[1] not in other_ends and ends[0] in other_ends:
            points, ends = points[::-1], (ends[1], ends[0])
        if other_ends[0] != ends[1] and other_ends[1] == ends[1]:
            other, other_ends = other[::-1], (other_ends[1], other_ends[0])
        points, ends = np.concatenate((points, other[1:])), (ends[0], other_ends[1])
    return points, ends


def _align_borders(
    left: Array, right: Array, left_ends: tuple[str, str], right_ends: tuple[str, str]
) -> tuple[Array, Array, tuple[str, str], tuple[str, str]]:
    """Return both borders turned along the lanelet's direction, in which the left one lies on the left."""
    same = np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1])
    crossed = np.linalg.norm(left[0] - right[-1]) + np.linalg.norm(left[-1] - right[0])
    if crossed < same:
        right, right_ends = right[::-1], (right_ends[1], right_ends[0])
    ring = np.concatenate((right, left[::-1]))[:, :2]
    x, y = ring.T
    if float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 0:
        return left[::-1], right[::-1], (left_ends[1], left_ends[0]), (right_ends[1], right_ends[0])
    return left, right, left_ends, right_ends


def _junctions(lanes: Sequence[Lane]) -> list[str | None]:
    """Return names of the junctions of drivable lanes: those that overlap another, in connected patches."""
    try:
        import shapely
    except ImportError:
        raise MissingExtraError("map", "Reading Lanelet2 maps") from None
    own = [lane for lane in lanes if lane.is_drivable]
    names: list[str | None] = [None] * len(lanes)
    if not own:
        return names
    rings = [np.concatenate((lane.left, lane.right[::-1]))[:, :2] for lane in own]
    grounds = shapely.make_valid([shapely.Polygon(ring) for ring in rings])
    one, two = shapely.STRtree(grounds).query(grounds, predicate="intersects")
    area = shapely.area(shapely.intersection(grounds[one], grounds[two]))
    both_ways = np.array([_share_ground(own[a], own[b]) for a, b in zip(one.tolist(), two.tolist())], bool)
    overlap = (one != two) & (area > _MIN_OVERLAP_M2) & ~both_ways
    for k, label in enumerate(connected_components(len(own), np.stack((one[overlap], two[overlap]), 1)).tolist()):
        if overlap[one == k].any():
            names[own[k].id] = own[label].road_id
    return names


def _share_ground(one: Lane, two: Lane) -> bool:
    """Return whether two lanes are the two directions of one strip, or a strip and its copy for other traffic."""
    width = float(np.median(one.width_m))
    middle = np.linalg.norm(one.center[len(one.center) // 2] - two.center[len(two.center) // 2])
    ends = [np.linalg.norm(one.center[a] - two.center[b]) for a, b in ((0, 0), (-1, -1), (0, -1), (-1, 0))]
    return bool(middle < width / 2 and (max(ends[:2]) < width / 2 or max(ends[2:]) < width / 2))


__all__ = ["Lanelet2Error", "lanelet2_origin", "read_lanelet2"]
