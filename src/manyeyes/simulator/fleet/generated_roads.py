# SPDX-License-Identifier: Apache-2.0
"""Generated roads of other shapes than a lattice: a roundabout with curved arms, and a curved road with a merge and a split.

Both are test places: nothing may be tuned on them. Boundaries are the outline of the paved ground, as in the truth of a road
network. Lines are cut at the ground of junctions, and dividers inside it are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, DOUBLE, NO_STYLE, STOP_LINE, MapElements
from manyeyes.simulator.fleet.generated_streets import LANE_M, canonical_points
from manyeyes.simulator.fleet.routes import Routes

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "A place to map")

Array = NDArray[np.float64]

HALF_SIZE_M = 160.0
"""Half of the side of the square in which the truth is known; roads lead beyond it."""
_ROAD_END_M, _BENT_M = 240.0, 90.0
_MIN_PIECE_M = 2.0

# Roundabout. Arms: angle (rad), lanes of each direction, curvature (1/m).
_ARMS = ((0.15, 2, 1 / 120), (1.7, 1, 1 / 85), (3.3, 2, -1 / 150), (5.0, 1, 1 / 100))
_ISLAND_M, _RING_LANE_M, _MOUTH_M, _FILLET_M = 24.0, 4.0, 44.0, 8.0
_RING_M = _ISLAND_M + 2 * _RING_LANE_M

# Road with a merge and a split. Distance of its ends from the middle; its bends (amplitude, wavelength / 2π); stations along it,
# metres from its western end.
_HALF_LENGTH_M, _BEND_M, _BEND_LENGTH_M, _HALF_ROAD_M = 200.0, 18.0, 55.0, 2 * LANE_M
_JUNCTION_AT_M, _ARM_AT_M = 294.0, 26.0
# Where the added lane leaves the road as a ramp, and where it begins to narrow and ends.
_MERGE_AT_M, _SPLIT_AT_M = (150.0, 208.0, 248.0), (160.0, 206.0, 240.0)
_RAMP_RADIUS_M, _RAMP_BEND_M, _GORE_M = 60.0, 60.0, 15.0
# Along the ramp that splits off: where it begins to widen to two lanes, and has widened.
_WIDENS_AT_M, _WIDE_AT_M = 70.0, 90.0


@dataclass(frozen=True, eq=False)
class RoadLayout:
    """Roads of a place, metres: paved ground, ground of its junctions, and routes.

    paint: dividers (M, 2) with their styles, before they are cut. rings, stop_lines: crossings (4, 2) and lines (2, 2).
    """

    pavement: BaseGeometry
    ground: BaseGeometry
    paint: tuple[tuple[int, Array], ...]
    rings: tuple[Array, ...]
    stop_lines: tuple[Array, ...]
    routes: Routes


def road_truth(layout: RoadLayout) -> MapElements:
    """Return the elements of a layout within ``HALF_SIZE_M``."""
    shapely = _shapely()
    box = shapely.box(-HALF_SIZE_M, -HALF_SIZE_M, HALF_SIZE_M, HALF_SIZE_M)
    edge = layout.pavement.boundary.intersection(box)
    placed: list[tuple[int, int, Array]] = []
    for part in (edge.difference(layout.ground), edge.intersection(layout.ground)):
        placed += [(BOUNDARY, NO_STYLE, points) for points in _pieces(part)]
    for style, line in layout.paint:
        cut = shapely.LineString(line).intersection(box).difference(layout.ground)
        placed += [(DIVIDER, style, points) for points in _pieces(cut)]
    placed += [(CROSSING, NO_STYLE, ring) for ring in layout.rings]
    placed += [(STOP_LINE, NO_STYLE, line) for line in layout.stop_lines]
    placed = [(kind, style, canonical_points(kind, points)) for kind, style, points in placed]
    placed.sort(key=lambda row: (row[0], *np.round(row[2][0], 6).tolist(), *np.round(row[2][-1], 6).tolist()))
    return MapElements.of(
        [row[2] for row in placed], [row[0] for row in placed], sigma=0.0, style=[row[1] for row in placed]
    )


def make_roundabout() -> RoadLayout:
    """Lay out a roundabout of two lanes, driven anticlockwise, with four curved arms of one or two lanes a direction."""
    shapely = _shapely()
    middle, lanes = shapely.Point(0, 0), _LaneTable()
    inside, island, ring, mouth = (
        middle.buffer(r, quad_segs=64) for r in (_ISLAND_M - 2.0, _ISLAND_M, _RING_M, _MOUTH_M)
    )
    angles = np.array([angle for angle, _, _ in _ARMS])
    halves = np.array([np.arcsin((n * LANE_M + _FILLET_M) / (_RING_M + _FILLET_M)) + 0.04 for _, n, _ in _ARMS])
    after = np.append(angles[1:], angles[0] + 2 * np.pi) - np.roll(halves, -1)
    radii = (_ISLAND_M + 0.5 * _RING_LANE_M, _ISLAND_M + 1.5 * _RING_LANE_M)
    at_arm = [[lanes.add(_arc(r, a - h, a + h)) for r in radii] for a, h in zip(angles, halves)]
    between = [[lanes.add(_arc(r, a + h, end)) for r in radii] for a, h, end in zip(angles, halves, after)]
    arms, pavement, grounds = [], [ring.difference(island)], []
    for k, (angle, num_lanes, curvature) in enumerate(_ARMS):
        start = (_ISLAND_M + _RING_LANE_M) * np.array([np.cos(angle), np.sin(angle)])
        axis = _bend(start, angle, curvature, _MOUTH_M - _ISLAND_M)
        arm = _Arm(axis[np.linalg.norm(axis, axis=1) >= _MOUTH_M], num_lanes)
        arms.append(arm)
        pavement.append(shapely.LineString(axis).buffer(arm.half_m, cap_style="flat"))
        sides = angle + np.array([-1.0, 1.0]) * halves[k]
        corners = 2 * _MOUTH_M * np.stack((np.cos(sides), np.sin(sides)), 1)
        grounds.append(shapely.Polygon([(0.0, 0.0), *corners]).intersection(mouth.difference(inside)))
        inbound, outbound = arm.add_lanes(lanes)
        for number in range(num_lanes):
            # The lane on the right leads to the outer lane of the ring.
            ring_lane = number + 2 - num_lanes
            lanes.link(inbound[number], between[k][ring_lane])
            lanes.link(between[k - 1][ring_lane], outbound[number])
        for ring_lane in range(2):
            lanes.follow(between[k - 1][ring_lane], at_arm[k][ring_lane])
            lanes.follow(at_arm[k][ring_lane], between[k][ring_lane])
    circle = (DASHED, _arc(_ISLAND_M + _RING_LANE_M, 0.0, 2 * np.pi))
    paved = _close(shapely.union_all([*pavement, lanes.swept_ground()]), _FILLET_M)
    return _make_layout(shapely.union_all(grounds), paved, [circle], arms, lanes)


def make_merge() -> RoadLayout:
    """Lay out a curved road of two lanes a direction: a ramp merges, a lane splits off and widens, a skewed road crosses."""
    shapely = _shapely()
    x = np.arange(-_HALF_LENGTH_M, _HALF_LENGTH_M, 0.25)
    road = _Axis(_resample(np.stack((x, _BEND_M * np.sin((x + 20.0) / _BEND_LENGTH_M)), 1)))
    (middle,), heading = road.at(_JUNCTION_AT_M), road.heading(_JUNCTION_AT_M)
    north, south = _bend(middle, heading + 1.2, -1 / 140, 0.0), _bend(middle, heading - 2.2, 1 / 300, 0.0)
    west_end = _JUNCTION_AT_M - _ARM_AT_M
    arms = [
        _Arm(road.strip(_JUNCTION_AT_M + _ARM_AT_M, road.length_m), 2),
        _Arm(north[int(_ARM_AT_M) :], 1),
        _Arm(road.strip(west_end, 0.0), 2),
        _Arm(south[int(_ARM_AT_M) :], 1),
    ]
    ground = shapely.MultiPoint(np.concatenate([arm.mouth() for arm in arms])).convex_hull
    # Traffic to the east keeps to negative offsets; each ramp adds a lane outside.
    entry, leaving = _Axis(road.ramp(_MERGE_AT_M[0], -1.0)), _Axis(road.ramp(_SPLIT_AT_M[0], 1.0))
    main = shapely.LineString(road.points).buffer(_HALF_ROAD_M, cap_style="flat")
    sides = [shapely.LineString(line).buffer(LANE_M, cap_style="flat") for line in (north, south)]
    lanes = _LaneTable()
    mouths = [arm.add_lanes(lanes) for arm in arms[:2]] + [_add_ramp_lanes(lanes, road, entry, leaving, west_end)]
    _cross(lanes, [*mouths, arms[3].add_lanes(lanes)])
    pavement = shapely.union_all([main, *sides, lanes.swept_ground()])
    pavement = pavement.union(_close(pavement, 5.0).intersection(ground))
    along = np.arange(0.0, leaving.length_m)
    width = LANE_M * (1.0 + np.clip((along - _WIDENS_AT_M) / (_WIDE_AT_M - _WIDENS_AT_M), 0.0, 1.0))
    parts = [
        pavement,
        _added_lane(road, _MERGE_AT_M, -1.0),
        _added_lane(road, _SPLIT_AT_M, 1.0),
        shapely.LineString(entry.points).buffer(LANE_M / 2, cap_style="flat"),
        shapely.Polygon(np.concatenate((leaving.at(along, width / 2), leaving.at(along, -width / 2)[::-1]))),
    ]
    paint = [
        (DASHED, road.strip(_MERGE_AT_M[0] - _GORE_M, _MERGE_AT_M[1] + 10.0, -_HALF_ROAD_M)),
        (DASHED, road.strip(_SPLIT_AT_M[0] - _GORE_M, _SPLIT_AT_M[1] + 10.0, _HALF_ROAD_M)),
        (DASHED, leaving.strip((_WIDENS_AT_M + _WIDE_AT_M) / 2, leaving.length_m)),
    ]
    rings = [_ring(entry, 45.0, LANE_M / 2), _ring(leaving, 105.0, LANE_M)]
    return _make_layout(ground, _close(shapely.union_all(parts), 1.0), paint, arms, lanes, rings)


def _make_layout(
    ground: BaseGeometry,
    pavement: BaseGeometry,
    paint: Sequence[tuple[int, Array]],
    arms: Sequence[_Arm],
    lanes: _LaneTable,
    rings: Sequence[Array] = (),
) -> RoadLayout:
    """Collect what arms have at a junction, and the rest."""
    paint = (*paint, *(line for arm in arms for line in arm.paint()))
    crossings = (*rings, *(_ring(_Axis(arm.points), -4.5, arm.half_m) for arm in arms))
    return RoadLayout(pavement, ground, paint, crossings, tuple(arm.stop_line() for arm in arms), lanes.to_routes())


@dataclass(frozen=True, eq=False)
class _Axis:
    """A line of points 1 m apart (M, 2); offsets are lateral, positive to the left of its direction."""

    points: Array

    @property
    def length_m(self) -> float:
        return float(len(self.points) - 1)

    def heading(self, station_m: float) -> float:
        """Return the direction at a station (rad)."""
        before, after = self._on_axis(np.array([station_m - 0.5, station_m + 0.5]))
        return float(np.arctan2(*(after - before)[::-1]))

    def at(self, station_m: Array | float, offset_m: Array | float = 0.0) -> Array:
        """Return points (K, 2) at stations and offsets; a station beyond an end lies straight ahead of it."""
        station, offset = np.broadcast_arrays(np.atleast_1d(station_m), offset_m)
        step = self._on_axis(station + 0.5) - self._on_axis(station - 0.5)
        normal = np.stack((-step[:, 1], step[:, 0]), 1) / np.linalg.norm(step, axis=1, keepdims=True)
        return self._on_axis(station) + offset[:, None] * normal

    def strip(self, start_m: float, end_m: float, offset_m: float = 0.0) -> Array:
        """Return the points from one station to another, about 1 m apart."""
        count = int(np.ceil(abs(end_m - start_m))) + 1
        return self.at(np.linspace(start_m, end_m, count), offset_m)

    def ramp(self, station_m: float, side: float) -> Array:
        """Return a ramp (M, 2) that leaves the lane beyond the road's edge backwards from a station; side: -1 right, 1 left."""
        back = np.arange(0.0, _RAMP_BEND_M + 0.5, 0.5)
        offset = side * (_HALF_ROAD_M + LANE_M / 2 + back**2 / (2 * _RAMP_RADIUS_M))
        return _resample(_Axis(_resample(self.at(station_m - back, offset))).strip(0.0, _ROAD_END_M))

    def _on_axis(self, station_m: Array) -> Array:
        last = len(self.points) - 1
        low = np.clip(np.floor(station_m).astype(np.int64), 0, last - 1)
        return self.points[low] + (station_m - low)[:, None] * (self.points[low + 1] - self.points[low])


@dataclass(frozen=True, eq=False)
class _Arm:
    """A road that leads away from a junction: its middle from the mouth outwards (M, 2), and the lanes of each direction."""

    points: Array
    num_lanes: int

    @property
    def half_m(self) -> float:
        return self.num_lanes * LANE_M

    def mouth(self) -> Array:
        """Return the ends (2, 2) of the mouth, beyond both edges."""
        return _Axis(self.points).at(np.zeros(2), np.array([-1.0, 1.0]) * (self.half_m + 2.0))

    def paint(self) -> list[tuple[int, Array]]:
        """Return the dividers and their styles."""
        axis, inner = _Axis(self.points), range(1 - self.num_lanes, self.num_lanes)
        return [(DOUBLE if k == 0 else DASHED, axis.strip(0.0, axis.length_m, k * LANE_M)) for k in inner]

    def stop_line(self) -> Array:
        """Return the stop line (2, 2) of the traffic towards the junction, which drives on the left of the axis."""
        return _Axis(self.points).at(np.ones(2), np.array([0.2, self.half_m - 0.2]))

    def add_lanes(self, lanes: _LaneTable) -> tuple[list[int], list[int]]:
        """Add lanes; returns those towards the junction and those away from it, from the middle to the edge."""
        axis, offsets = _Axis(self.points), [(k + 0.5) * LANE_M for k in range(self.num_lanes)]
        inbound = [lanes.add(axis.strip(axis.length_m, 0.0, offset)) for offset in offsets]
        return inbound, [lanes.add(axis.strip(0.0, axis.length_m, -offset)) for offset in offsets]


class _LaneTable:
    """Lanes and their successors under construction."""

    def __init__(self) -> None:
        self.lanes: list[Array] = []
        self.successors: list[tuple[int, int]] = []
        self.links: list[Array] = []

    def add(self, points: Array, before: Iterable[int] = (), after: Iterable[int] = ()) -> int:
        """Add a lane (M, 2) between others; returns its number."""
        number = len(self.lanes)
        self.lanes.append(points)
        self.successors += [(one, number) for one in before] + [(number, one) for one in after]
        return number

    def follow(self, one: int, other: int) -> None:
        """Let a lane follow another at whose end it begins."""
        self.successors.append((one, other))

    def link(self, one: int, other: int) -> None:
        """Add a lane from the end of one to the start of another: a cubic Hermite curve, close to an arc where one fits."""
        a, b = self.lanes[one], self.lanes[other]
        start, end, distance = a[-1], b[0], np.linalg.norm(b[0] - a[-1])
        u, v = (step / np.linalg.norm(step) for step in (a[-1] - a[-2], b[1] - b[0]))
        # cos²(a quarter of the turn) by half-angle formulas.
        speed = 2 * distance / (1.0 + np.sqrt(max(0.0, 1.0 + u @ v) / 2.0))
        u, v = speed * u, speed * v
        t = np.linspace(0.0, 1.0, max(3, int(distance)))[:, None]
        line = (1 + 2 * t) * (1 - t) ** 2 * start + t * (1 - t) ** 2 * u + t**2 * (3 - 2 * t) * end - t**2 * (1 - t) * v
        self.links.append(line)
        self.add(line, (one,), (other,))

    def swept_ground(self) -> BaseGeometry:
        """Return the ground that vehicles need on the links."""
        return _shapely().MultiLineString(self.links).buffer(0.6 * LANE_M, cap_style="flat")

    def to_routes(self) -> Routes:
        return Routes.of(self.lanes, self.successors)


def _add_ramp_lanes(
    lanes: _LaneTable, road: _Axis, entry: _Axis, leaving: _Axis, end_m: float
) -> tuple[list[int], list[int]]:
    """Add the lanes west of the junction with both ramps; returns as :meth:`_Arm.add_lanes`."""
    inner, outer, added = 0.5 * LANE_M, 1.5 * LANE_M, 2.5 * LANE_M
    join, part = _MERGE_AT_M[2] - 10.0, _SPLIT_AT_M[2]
    east = [lanes.add(road.strip(0.0, end_m, -inner)), lanes.add(road.strip(join, end_m, -outer))]
    lanes.add(road.strip(0.0, join, -outer), after=(east[1],))
    station = np.arange(_MERGE_AT_M[0], join + 0.5)
    offset = -np.interp(station, (_MERGE_AT_M[1] - 10.0, join), (added, outer))
    lanes.add(np.concatenate((entry.points[:0:-1], road.at(station, offset))), after=(east[1],))
    west = [lanes.add(road.strip(end_m, 0.0, inner)), lanes.add(road.strip(end_m, part, outer))]
    lanes.add(road.strip(part, 0.0, outer), before=(west[1],))
    station = np.arange(part, _SPLIT_AT_M[0] - 0.5, -1.0)
    offset = np.interp(station, (_SPLIT_AT_M[1] - 10.0, part), (added, outer))
    fork = int(_WIDENS_AT_M)
    ramp = lanes.add(np.concatenate((road.at(station, offset), leaving.points[1 : fork + 1])), before=(west[1],))
    along = np.arange(fork, leaving.length_m)
    for side in (-1.0, 1.0):
        offset = side * np.interp(along, (_WIDENS_AT_M, _WIDE_AT_M), (0.0, LANE_M / 2))
        lanes.add(leaving.at(along, offset), before=(ramp,))
    return east, west


def _cross(lanes: _LaneTable, arms: Sequence[tuple[list[int], list[int]]]) -> None:
    """Link the lanes towards a junction to those away from it: right turns from the edge, left turns from the middle."""

    def heading(number: int, last: bool) -> float:
        points = lanes.lanes[number]
        return float(np.arctan2(*(points[-1] - points[-2] if last else points[1] - points[0])[::-1]))

    for i, (inbound, _) in enumerate(arms):
        for j, (_, outbound) in enumerate(arms):
            if i == j:
                continue
            turn = (heading(outbound[0], False) - heading(inbound[0], True) + np.pi) % (2 * np.pi) - np.pi
            if abs(turn) < 0.6:
                pairs = list(zip(inbound, outbound))
            else:
                pairs = [(inbound[0], outbound[0]) if turn > 0 else (inbound[-1], outbound[-1])]
            for one, other in pairs:
                lanes.link(one, other)


def _added_lane(road: _Axis, at_m: tuple[float, float, float], side: float) -> BaseGeometry:
    """Return the ground of a lane beside a road, which narrows to nothing."""
    start, narrows, end = at_m
    station = np.arange(start - 1.0, end + 0.5)
    outer = _HALF_ROAD_M + LANE_M * np.clip((end - station) / (end - narrows), 0.0, 1.0)
    inner = road.at(station, side * (_HALF_ROAD_M - 0.1))
    return _shapely().Polygon(np.concatenate((inner, road.at(station, side * outer)[::-1])))


def _ring(axis: _Axis, start_m: float, half_m: float) -> Array:
    """Return the crossing (4, 2), 4 m wide, that begins at a station of a road."""
    return axis.at(start_m + np.array([0.0, 4.0, 4.0, 0.0]), half_m * np.array([-1.0, -1.0, 1.0, 1.0]))


def _pieces(lines: BaseGeometry) -> list[Array]:
    """Return the connected lines (M, 2) of a geometry, points at most 1 m apart."""
    shapely = _shapely()
    merged = shapely.get_parts(shapely.line_merge(shapely.simplify(lines, 0.01)))
    kept = [part for part in merged if part.geom_type == "LineString" and part.length >= _MIN_PIECE_M]
    return [shapely.get_coordinates(shapely.segmentize(part, 1.0)) for part in kept]


def _close(ground: BaseGeometry, radius_m: float) -> BaseGeometry:
    """Round the inner corners of a ground."""
    return ground.buffer(radius_m, quad_segs=16).buffer(-radius_m, quad_segs=16)


def _arc(radius_m: float, start: float, end: float) -> Array:
    """Return an arc about zero from one angle to another, points about 1 m apart."""
    angle = np.linspace(start, end, int(np.ceil(radius_m * abs(end - start))) + 1)
    return radius_m * np.stack((np.cos(angle), np.sin(angle)), 1)


def _bend(start: Array, heading: float, curvature: float, straight_m: float) -> Array:
    """Return a line of 1 m steps from a point: straight, bent for ``_BENT_M`` with curvature that grows within 20 m, straight."""
    station = np.arange(_ROAD_END_M) - straight_m
    turn = np.cumsum(curvature * np.clip(station / 20.0, 0.0, 1.0) * (station < _BENT_M))
    step = np.stack((np.cos(heading + turn), np.sin(heading + turn)), 1)
    return np.concatenate(([start], start + np.cumsum(step, 0)))


def _resample(points: Array) -> Array:
    """Return a line with points 1 m apart."""
    station = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    at = np.arange(np.floor(station[-1]) + 1.0)
    return np.stack([np.interp(at, station, points[:, axis]) for axis in (0, 1)], 1)
