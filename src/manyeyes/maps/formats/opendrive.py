# SPDX-License-Identifier: Apache-2.0
"""Read OpenDRIVE 1.4 (.xodr, plain or gzip) into a RoadNetwork (ASAM OpenDRIVE 1.4H, by section in the functions).

What the file does not say is filled in so: a broken line without <line> children is 3 m of dash and 6 m of gap, a mark without
a width is 0.12 m wide, a stop line 0.4 m. A double line becomes two marks whose centres lie two widths apart.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manyeyes._io import MAX_TEXT_BYTES, read_file, unpack_gzip
from manyeyes.datatypes import ManyeyesError
from manyeyes.maps.formats.opendrive_geometry import Array, Cubics, Primitive, ReferenceLine
from manyeyes.maps.formats.opendrive_links import link_lanes, read_junctions
from manyeyes.maps.roads.road_network import Crossing, Lane, ParkingSpace, Road, RoadMark, RoadNetwork

STEP_M = 1.0
TIGHT_STEP_M = 0.5
_MAX_LENGTH_M, _MAX_COORDINATE_M, _MAX_POINTS = 1e5, 1e8, 10_000_000
"""Maximum length of a road, distance from the origin, and number of sampled points of all lanes."""
_DASH_M, _GAP_M = 3.0, 6.0
_MARK_WIDTH_M, _STOP_WIDTH_M = 0.12, 0.4
_DEFAULT_SPEED_MPS = 13.9
_SPEED_UNITS = {"m/s": 1.0, "mph": 0.44704, "km/h": 1 / 3.6}
_PARAMETERS = {
    "line": (),
    "arc": ("curvature",),
    "spiral": ("curvStart", "curvEnd"),
    "poly3": ("a", "b", "c", "d"),
    "paramPoly3": ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"),
}


class OpenDriveError(ManyeyesError):
    """An OpenDRIVE file that cannot be read; the text names the file and the element."""


@dataclass(frozen=True, eq=False)
class _Record:
    """A road as it is being read."""

    element: ET.Element
    id: str
    junction_id: str | None
    line: ReferenceLine
    lane_offset: Cubics
    speed_mps: float
    left_hand: bool


def read_opendrive(source: Path | str | bytes, name: str | None = None, step_m: float = STEP_M) -> RoadNetwork:
    """Return the roads of a file, or of its bytes, sampled at most step_m apart (half of that in tight curves)."""
    if isinstance(source, bytes):
        label, data = name or "OpenDRIVE bytes", source
    else:
        label = str(source)
        try:
            data = read_file(Path(source), MAX_TEXT_BYTES)
        except OSError as error:
            raise OpenDriveError(
                f"{label}: cannot be read ({error.strerror}); give the path of an .xodr file."
            ) from error
    try:
        data = unpack_gzip(data, MAX_TEXT_BYTES) if data[:2] == b"\x1f\x8b" else data
        root = ET.fromstring(data)
    except OSError as error:
        raise OpenDriveError(f"{label}: expected OpenDRIVE XML, plain or gzip; {error.strerror or error}.") from error
    except (ET.ParseError, ValueError, LookupError) as error:
        raise OpenDriveError(f"{label}: expected OpenDRIVE XML, plain or gzip; {error}.") from error
    if root.tag != "OpenDRIVE":
        raise OpenDriveError(f"{label}: expected the root element <OpenDRIVE>; got <{root.tag}>.")
    stem = name or Path(label).name.split(".")[0]
    return _OpenDriveReader(label, min(step_m, TIGHT_STEP_M * 2), root).network(stem, data)


class _OpenDriveReader:
    """One file on its way to a RoadNetwork; holds what is wanted for error texts and the lanes made so far."""

    def __init__(self, label: str, step_m: float, root: ET.Element) -> None:
        self.label, self.step_m, self.root = label, step_m, root
        self.lanes: list[Lane] = []
        self.marks: list[RoadMark] = []
        self.num_points = 0

    def network(self, name: str, data: bytes) -> RoadNetwork:
        """Read the whole file into a RoadNetwork."""
        records = [self.record(road) for road in self.root.findall("road")]
        if not records:
            raise OpenDriveError(f"{self.label}: no <road> element; the file describes no roads.")
        roads, crossings, parking = [], [], []
        for record in records:
            roads.append(self.road(record))
            for item in self.objects(record):
                if isinstance(item, Crossing):
                    crossings.append(item)
                elif isinstance(item, ParkingSpace):
                    parking.append(item)
                else:
                    self.marks.append(item)
        left_hand = {record.id for record in records if record.left_hand}
        lanes = link_lanes(self.root, self.lanes, left_hand)
        junctions = read_junctions(self.root, lanes)
        return RoadNetwork(
            name, tuple(roads), lanes, tuple(self.marks), tuple(crossings), tuple(parking), junctions, xodr=data
        )

    def number(self, element: ET.Element, attribute: str, context: str, default: float | None = None) -> float:
        """Return an attribute as a finite number; an error that names file, element and attribute otherwise."""
        text = element.get(attribute)
        if text is None and default is not None:
            return default
        try:
            value = float(text) if text is not None else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise OpenDriveError(
                f"{self.label}: {context} <{element.tag}> needs a number in '{attribute}'; got {text!r}."
            )
        return value

    def length(self, element: ET.Element, context: str) -> float:
        """Return the attribute 'length' as a number from 0 to its maximum."""
        length = self.number(element, "length", context)
        if not 0 <= length <= _MAX_LENGTH_M:
            raise OpenDriveError(
                f"{self.label}: {context} <{element.tag}> needs a 'length' from 0 to {_MAX_LENGTH_M:,.0f} m; got {length:g}."
            )
        return length

    def points(self, record: _Record, s: Array, t: Array) -> Array:
        """Return world points (M, 3) at stations s and lateral offsets t (M,), within bounds."""
        with np.errstate(all="ignore"):
            points = record.line.points(s, t)
        if not (np.abs(points) <= _MAX_COORDINATE_M).all():
            raise OpenDriveError(
                f"{self.label}: road {record.id}: expected points within {_MAX_COORDINATE_M:g} m of the origin; "
                "its geometry, lane widths or heights lead farther or to no number."
            )
        return points

    def cubics(self, elements: Iterable[ET.Element], context: str, start: str = "s") -> Cubics:
        """Records a, b, c, d over s (or sOffset) as one function; zero everywhere when there are none."""
        rows = [(self.number(e, start, context, 0.0), *(self.number(e, c, context) for c in "abcd")) for e in elements]
        if not rows:
            return Cubics.constant(0.0)
        table = np.array(sorted(rows, key=lambda row: row[0]))
        return Cubics(table[:, 0], table[:, 1:])

    def record(self, road: ET.Element) -> _Record:
        """Return a road's reference line, lane offset and speed (1.4H §5.3.1–5.3.5)."""
        road_id = road.get("id")
        if road_id is None:
            raise OpenDriveError(f"{self.label}: a <road> has no 'id'.")
        context = f"road {road_id}:"
        pieces = tuple(self.primitive(g, context) for g in road.findall("planView/geometry"))
        if not pieces:
            raise OpenDriveError(f"{self.label}: {context} <planView> holds no <geometry>.")
        line = ReferenceLine(
            tuple(sorted(pieces, key=lambda piece: piece.s)),
            self.cubics(road.findall("elevationProfile/elevation"), context),
            self.cubics(road.findall("lateralProfile/superelevation"), context),
            self.length(road, context),
        )
        junction = road.get("junction", "-1")
        return _Record(
            road,
            road_id,
            None if junction in ("-1", "") else junction,
            line,
            self.cubics(road.findall("lanes/laneOffset"), context),
            self.speed(road.find("type/speed"), context),
            road.get("rule", "RHT") == "LHT",
        )

    def speed(self, element: ET.Element | None, context: str, default: float = _DEFAULT_SPEED_MPS) -> float:
        """Return a speed limit in m/s; 'no limit' and 'undefined' give the default."""
        if element is None or element.get("max", "undefined") in ("no limit", "undefined"):
            return default
        return self.number(element, "max", context) * _SPEED_UNITS.get(element.get("unit", "m/s"), 1.0)

    def primitive(self, geometry: ET.Element, context: str) -> Primitive:
        """Return one <geometry> of the plan view (1.4H §5.3.4)."""
        shape = next((child for child in geometry if child.tag in _PARAMETERS), None)
        if shape is None:
            got = ", ".join(f"<{child.tag}>" for child in geometry) or "nothing"
            raise OpenDriveError(
                f"{self.label}: {context} <geometry> needs one of {', '.join(_PARAMETERS)}; it holds {got}."
            )
        values = tuple(self.number(shape, key, context) for key in _PARAMETERS[shape.tag])
        if shape.tag == "paramPoly3":
            values = (*values, 0.0 if shape.get("pRange") == "arcLength" else 1.0)
        s, x, y, heading = (self.number(geometry, key, context) for key in ("s", "x", "y", "hdg"))
        return Primitive(s, x, y, heading, self.length(geometry, context), shape.tag, values)

    def road(self, record: _Record) -> Road:
        """Return a road's lanes and marks, appended; and the road itself."""
        sections = record.element.findall("lanes/laneSection")
        if not sections:
            raise OpenDriveError(f"{self.label}: road {record.id}: <lanes> holds no <laneSection>.")
        first = len(self.lanes)
        starts = [self.number(section, "s", f"road {record.id}:") for section in sections]
        if min(starts) < 0 or max(starts) > record.line.length:
            raise OpenDriveError(
                f"{self.label}: road {record.id}: <laneSection> needs an 's' on the road of {record.line.length:g} m."
            )
        ends = [*starts[1:], record.line.length]
        for k, (section, start, end) in enumerate(zip(sections, starts, ends)):
            if end > start:
                self.section(record, section, k, start, end)
        s = record.line.stations(0.0, record.line.length, self.step_m, self.step_m / 2, np.zeros(0))
        reference = self.points(record, s, np.zeros_like(s))
        ids = tuple(range(first, len(self.lanes)))
        return Road(record.id, record.line.length, record.junction_id, reference, s, ids)

    def section(self, record: _Record, section: ET.Element, index: int, start: float, end: float) -> None:
        """Lanes of one lane section from the centre outwards; neighbours share their border's points (1.4H §5.3.7)."""
        elements = {int(self.number(e, "id", f"road {record.id}:")): e for e in section.iter("lane")}
        offsets = [
            start + self.number(e, "sOffset", f"road {record.id}:", 0.0)
            for lane in elements.values()
            for tag in ("width", "border", "roadMark")
            for e in lane.findall(tag)
        ]
        s = record.line.stations(
            start, end, self.step_m, self.step_m / 2, np.array([*offsets, *record.lane_offset.start])
        )
        self.num_points += len(s) * (1 + sum(1 + len(e.findall("roadMark")) for e in elements.values()))
        if self.num_points > _MAX_POINTS:
            raise OpenDriveError(
                f"{self.label}: road {record.id}: more than {_MAX_POINTS:,} points of lanes; split the file."
            )
        # Where the lanes are renumbered, <laneOffset> jumps: the section's end takes the value from its own side.
        middle = record.lane_offset(np.concatenate((s[:-1], [s[-1] - 1e-6])))
        if 0 in elements:
            self.border_marks(record, elements[0], index, s, middle, start)
        for side in (1, -1):
            inner = middle
            inner_points = self.points(record, s, inner)
            for lane_id in sorted((i for i in elements if i * side > 0), key=abs):
                element = elements[lane_id]
                context = f"road {record.id} section {index} lane {lane_id}:"
                outer = self.outer_border(element, context, s - start, inner, middle, side)
                outer_points = self.points(record, s, outer)
                self.add_lane(record, element, index, lane_id, inner_points, outer_points)
                self.border_marks(record, element, index, s, outer, start)
                inner, inner_points = outer, outer_points

    def outer_border(
        self, element: ET.Element, context: str, along: Array, inner: Array, middle: Array, side: int
    ) -> Array:
        """t (M,) of a lane's outer border from its <width> records, or from its <border> records."""
        if element.find("width") is None and element.find("border") is not None:
            return middle + self.cubics(element.findall("border"), context, "sOffset")(along)
        return inner + side * np.maximum(self.cubics(element.findall("width"), context, "sOffset")(along), 0.0)

    def add_lane(
        self, record: _Record, element: ET.Element, section: int, lane_id: int, inner: Array, outer: Array
    ) -> None:
        """Append one lane, turned so that its points run with its traffic."""
        against = (lane_id > 0) != record.left_hand
        if against:
            inner, outer = inner[::-1], outer[::-1]
        left, right = (outer, inner) if record.left_hand else (inner, outer)
        limit = self.speed(element.find("speed"), f"road {record.id}:", record.speed_mps)
        self.lanes.append(
            Lane(
                len(self.lanes),
                record.id,
                section,
                lane_id,
                element.get("type", "none"),
                record.junction_id,
                limit,
                left,
                right,
                (left + right) / 2,
            )
        )

    def border_marks(
        self, record: _Record, element: ET.Element, section: int, s: Array, t: Array, start: float
    ) -> None:
        """The lines along one border, cut where the <roadMark> changes (1.4H §5.3.7.2.1.1.4)."""
        context = f"road {record.id} section {section}:"
        lane_id = int(element.get("id", "0"))
        found = sorted(
            ((start + self.number(e, "sOffset", context, 0.0), e) for e in element.findall("roadMark")),
            key=lambda pair: pair[0],
        )
        for k, (low, mark) in enumerate(found):
            high = found[k + 1][0] if k + 1 < len(found) else s[-1]
            within = (s >= low - 1e-3) & (s <= high + 1e-3)
            if within.sum() < 2:
                continue
            for offset, kind, width, dash, gap in self.lines(mark, context, lane_id):
                line = self.points(record, s[within], t[within] + offset)
                color = {"standard": "white"}.get(mark.get("color", "standard"), mark.get("color", "white"))
                self.marks.append(RoadMark(line, kind, color, width, dash, gap, record.id, section, lane_id))

    def lines(self, mark: ET.Element, context: str, lane_id: int) -> list[tuple[float, str, float, float, float]]:
        """Return (lateral offset, kind, width, dash, gap) of each physical line of a <roadMark>.

        Of a pair, the first named is the inner one; on the centre lane the left one (1.4H §5.3.7.2.1.1.4).
        """
        width = self.number(mark, "width", context, _MARK_WIDTH_M) or _MARK_WIDTH_M
        kind = mark.get("type", "none")
        if kind == "curb":
            return [(0.0, "curb", width, 0.0, 0.0)]
        kinds = [word for word in kind.split() if word in ("solid", "broken", "botts")]
        if not kinds:
            return []
        child = mark.find("type/line")
        dash = self.number(child, "length", context, _DASH_M) if child is not None else _DASH_M
        gap = self.number(child, "space", context, _GAP_M) if child is not None else _GAP_M
        outward = -1.0 if lane_id <= 0 else 1.0
        spread = [0.0] if len(kinds) == 1 else [-width * outward, width * outward]
        return [
            (offset, "solid", width, 0.0, 0.0) if word == "solid" else (offset, "broken", width, dash or _DASH_M, gap)
            for offset, word in zip(spread, kinds)
        ]

    def objects(self, record: _Record) -> list[Crossing | ParkingSpace | RoadMark]:
        """Return crossings, parking spaces and painted lines among the road's <object>s (1.4H §5.3.8)."""
        found: list[Crossing | ParkingSpace | RoadMark] = []
        for element in record.element.findall("objects/object"):
            kind, name = (element.get("type") or "").lower(), element.get("name") or ""
            if kind == "crosswalk" or "crosswalk" in name.lower():
                polygon = self.outline(record, element)
                if len(polygon) >= 3:
                    found.append(Crossing(polygon, record.id, name))
            elif kind == "parking" or kind == "parkingspace":
                found.append(ParkingSpace(self.outline(record, element), record.id))
            elif name in ("StopLine", "SolidSingleWhite"):
                line = self.outline(record, element)
                if len(line) >= 2:
                    stop = name == "StopLine"
                    width = _STOP_WIDTH_M if stop else _MARK_WIDTH_M
                    found.append(RoadMark(line, "stop" if stop else "solid", "white", width, road_id=record.id))
        return found

    def outline(self, record: _Record, element: ET.Element) -> Array:
        """Return world points (M, 3) of an object's outline, not closed; its length × width rectangle when it has none."""
        context = f"road {record.id} object {element.get('id')}:"
        s, t = self.number(element, "s", context), self.number(element, "t", context)
        corners = [e for e in element.iter() if e.tag == "cornerRoad"]
        if corners:
            st = np.array([[self.number(e, key, context) for key in ("s", "t")] for e in corners])
            points = self.points(record, st[:, 0], st[:, 1])
            points[:, 2] += [self.number(e, "dz", context, 0.0) for e in corners]
            return _open(points)
        origin = self.points(record, np.array([s]), np.array([t]))[0]
        origin[2] += self.number(element, "zOffset", context, 0.0)
        angle = record.line.pose(np.array([s]))[2][0] + self.number(element, "hdg", context, 0.0)
        local = [e for e in element.iter() if e.tag == "cornerLocal"]
        if local:
            uvz = np.array([[self.number(e, key, context) for key in ("u", "v", "z")] for e in local])
        else:
            half_u, half_v = self.number(element, "length", context) / 2, self.number(element, "width", context) / 2
            uvz = np.array([[x * half_u, y * half_v, 0.0] for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
        c, n = math.cos(angle), math.sin(angle)
        turned = np.stack((c * uvz[:, 0] - n * uvz[:, 1], n * uvz[:, 0] + c * uvz[:, 1], uvz[:, 2]), -1)
        return _open(origin + turned)


def _open(points: Array) -> Array:
    """Return a ring without its repeated last point."""
    closed = len(points) > 3 and np.linalg.norm(points[0] - points[-1]) < 1e-3
    return points[:-1] if closed else points


__all__ = ["OpenDriveError", "read_opendrive"]
