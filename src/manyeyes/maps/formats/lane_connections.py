# SPDX-License-Identifier: Apache-2.0
"""Directions of lanes, and connections between lanes that end near each other, as on junctions and in gaps.

Lines do not tell a direction. It is taken from stop lines: lanes that end at one lead to it, the others beside them away from
it. Else from a double line: traffic keeps to the right of it, or to the left where ``drives_on_right`` is false. Else it is
unknown.

A connection runs from the end of a lane that leads there to the start of a lane that leads away, in a curve tangent to both:
straight on into the lane ahead, by turns from the outermost lane of that hand into the outermost. Lanes of unknown direction
are connected both ways.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import DOUBLE, STOP_LINE
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.lane_sections import LaneGraph, LaneSection, Piece

Floats = NDArray[np.float64]
Key = tuple[int, int]

MAX_GAP_M = 60.0
# A stop line lies so near to the end of its lanes: beyond it, or before it.
_STOP_AHEAD_M, _STOP_BEHIND_M = 8.0, 15.0
_STRAIGHT_RAD, _MAX_TURN_RAD = 0.5, 2.2
_MAX_SHIFT_M = 1.75
_HANDLE = 0.4
_CURVE_POINTS = 9


@dataclass(frozen=True, eq=False)
class _LaneEnd:
    """A free end of a lane: its section, keys and places of its points at the left and right hand of who leaves the lane there.

    leads_out, leads_in: whether traffic may leave the lane there, and enter it.
    """

    section: int
    left: Key
    right: Key
    left_xy: Floats
    right_xy: Floats
    heading: Floats
    leads_out: bool
    leads_in: bool

    @property
    def middle(self) -> Floats:
        return (self.left_xy + self.right_xy) / 2


def connect_lanes(graph: LaneGraph, vector_map: VectorMap, drives_on_right: bool = True) -> list[tuple[int, int]]:
    """Give the sections of a graph directions, and add connections; return (row of a stop line, section that ends at it)."""
    stops = np.flatnonzero(vector_map.elements.kind == STOP_LINE).tolist()
    stopped = _find_stopped(graph, vector_map, stops)
    directions = _directions_by_double_lines(graph, vector_map, drives_on_right)
    directions |= _directions_by_stop_lines(graph, stopped)
    graph.sections[:] = [replace(s, direction=directions.get(s.lane, 0)) for s in graph.sections]
    keys = {(piece.first, piece.last): number for number, piece in enumerate(graph.pieces)}
    for a, b, both_ways in _choose_connections(_find_free_ends(graph)):
        left = _add_curve(graph, keys, (a.left, b.right, True), (a.left_xy, a.heading, b.right_xy, -b.heading))
        right = _add_curve(graph, keys, (a.right, b.left, False), (a.right_xy, a.heading, b.left_xy, -b.heading))
        graph.add_section(LaneSection(left[0], right[0], left[1], right[1], lane=-1, direction=0 if both_ways else 1))
    return [(row, section) for row, section, _ in stopped]


def _find_stopped(graph: LaneGraph, vector_map: VectorMap, stops: list[int]) -> list[tuple[int, int, int]]:
    """Return (stop line, section, 1 or -1): sections whose axis meets a stop line near their end, or near their start."""
    out = []
    counts = _count_ends(graph)
    for number, section in enumerate(graph.sections):
        for sign in (1, -1):
            if counts[frozenset(graph.ends(section, sign > 0))] > 1:
                continue
            step, place = graph.heading_outward(section, sign > 0), graph.middle_line(section)[-1 if sign > 0 else 0]
            begin, end = place - _STOP_BEHIND_M * step, place + _STOP_AHEAD_M * step
            out += [(row, number, sign) for row in stops if _meets(begin, end, vector_map.elements.polyline(row))]
    return out


def _meets(begin: Floats, end: Floats, line: Floats) -> bool:
    """Return whether a straight segment crosses the chord of a line."""
    first, last = line[0], line[-1]

    def side(a: Floats, b: Floats, p: Floats) -> float:
        return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))

    return (
        side(first, last, begin) * side(first, last, end) < 0 and side(begin, end, first) * side(begin, end, last) < 0
    )


def _directions_by_stop_lines(graph: LaneGraph, stopped: list[tuple[int, int, int]]) -> dict[int, int]:
    """Return by lane: towards its stop line; away from it for lanes beside that have none there."""
    votes: Counter[int] = Counter()
    for _, number, sign in stopped:
        votes[graph.sections[number].lane] += sign
    directions = {lane: int(np.sign(vote)) for lane, vote in votes.items() if vote}
    for lane, direction in _spread(graph, directions).items():
        directions.setdefault(lane, direction)
    return directions


def _spread(graph: LaneGraph, known: dict[int, int]) -> dict[int, int]:
    """Return directions of lanes beside lanes with a stop line, which have none themselves: the opposite of theirs."""
    out: dict[int, int] = {}
    front, neighbours = dict(known), _neighbours(graph)
    while front:
        reached: dict[int, int] = {}
        for one, other, sign in neighbours:
            if one in front and other not in known and other not in out:
                # Lanes of the front that have a stop line themselves are passed: beside them traffic runs the other way.
                reached[other] = sign * front[one] * (-1 if one in known else 1)
        out |= reached
        front = reached
    return out


def _neighbours(graph: LaneGraph) -> list[tuple[int, int, int]]:
    """Return (lane, lane beside it, 1 if both run along the same way or -1), each pair in both orders."""
    sides: dict[int, list[tuple[int, bool, bool]]] = {}
    for section in graph.sections:
        sides.setdefault(section.left, []).append((section.lane, section.left_reversed, True))
        sides.setdefault(section.right, []).append((section.lane, section.right_reversed, False))
    out = set()
    for found in sides.values():
        for lane, turned, is_left in found:
            for other, other_turned, other_left in found:
                # On a piece, a section on its left hand and one on its right hand.
                if lane != other and (is_left == turned) != (other_left == other_turned):
                    out.add((lane, other, 1 if turned == other_turned else -1))
    return sorted(out)


def _directions_by_double_lines(graph: LaneGraph, vector_map: VectorMap, drives_on_right: bool) -> dict[int, int]:
    """Return by lane: along it if a double line bounds it, or a lane beside it, on the left hand (on the right, for left-hand
    traffic).
    """
    style = vector_map.elements.style.argmax(1)
    inner = {n for n, piece in enumerate(graph.pieces) if piece.row >= 0 and style[piece.row] == DOUBLE}
    directions: dict[int, int] = {}
    for section in graph.sections:
        for piece, is_left in ((section.left, True), (section.right, False)):
            if piece in inner:
                directions[section.lane] = 1 if is_left == drives_on_right else -1
    beside: dict[int, set[int]] = {}
    for section in graph.sections:
        for piece in inner & {section.left, section.right}:
            beside.setdefault(piece, set()).add(section.lane)
    across = {(one, other) for lanes in beside.values() for one in lanes for other in lanes}
    neighbours = _neighbours(graph)
    grown = True
    while grown:
        grown = False
        for one, other, sign in neighbours:
            if one in directions and other not in directions and (one, other) not in across:
                directions[other] = sign * directions[one]
                grown = True
    return directions


def _count_ends(graph: LaneGraph) -> Counter[frozenset[Key]]:
    """Return how many sections begin or end at two points."""
    return Counter(frozenset(graph.ends(s, at_end)) for s in graph.sections for at_end in (False, True))


def _find_free_ends(graph: LaneGraph) -> list[_LaneEnd]:
    """Return the ends of sections at which no other begins."""
    out = []
    counts = _count_ends(graph)
    for number, section in enumerate(graph.sections):
        for at_end in (False, True):
            keys = graph.ends(section, at_end)
            if counts[frozenset(keys)] > 1:
                continue
            left, right = graph.side(section, True), graph.side(section, False)
            first, second = (left[-1], right[-1]) if at_end else (right[0], left[0])
            out.append(
                _LaneEnd(
                    section=number,
                    left=keys[0 if at_end else 1],
                    right=keys[1 if at_end else 0],
                    left_xy=first,
                    right_xy=second,
                    heading=graph.heading_outward(section, at_end),
                    leads_out=section.direction in (0, 1 if at_end else -1),
                    leads_in=section.direction in (0, -1 if at_end else 1),
                )
            )
    return out


def _choose_connections(ends: list[_LaneEnd]) -> list[tuple[_LaneEnd, _LaneEnd, bool]]:
    """Return (from, to, whether it is open both ways), each pair of ends once."""
    out = []
    done: set[frozenset[int]] = set()
    middle = np.array([end.middle for end in ends]).reshape(-1, 2)
    for i, a in enumerate(ends):
        near = np.flatnonzero(np.hypot(*(middle - a.middle).T) <= MAX_GAP_M).tolist()
        around = [ends[k] for k in near]
        for j in near:
            b, pair = ends[j], frozenset((i, j))
            if i == j or pair in done or not (a.leads_out and b.leads_in) or not _is_connected(around, a, b):
                continue
            done.add(pair)
            out.append((a, b, a.leads_in and b.leads_out))
    return out


def _is_connected(ends: list[_LaneEnd], a: _LaneEnd, b: _LaneEnd) -> bool:
    """Return whether the lane that ends at a goes on into the lane that starts at b."""
    step = b.middle - a.middle
    gap = float(np.hypot(*step))
    if not 0.1 < gap <= MAX_GAP_M or float(step @ a.heading) < 0.2 * gap or float(-step @ b.heading) < 0.2 * gap:
        return False
    onward = -b.heading
    turn = float(np.arctan2(a.heading[0] * onward[1] - a.heading[1] * onward[0], a.heading @ onward))
    if abs(turn) < _STRAIGHT_RAD:
        bearing = a.heading + onward
        bearing = bearing / max(float(np.hypot(*bearing)), 1e-9)
        shift = abs(bearing[0] * step[1] - bearing[1] * step[0])
        return bool(shift <= _MAX_SHIFT_M) and not _is_hidden(ends, a, b)
    if abs(turn) > _MAX_TURN_RAD:
        return False
    to_left = turn > 0
    return not _has_outer(ends, a, to_left, outward=True) and not _has_outer(ends, b, not to_left, outward=False)


def _is_hidden(ends: list[_LaneEnd], a: _LaneEnd, b: _LaneEnd) -> bool:
    """Return whether another lane's end that traffic may enter lies between, straight ahead of a."""
    gap = float((b.middle - a.middle) @ a.heading)
    for other in ends:
        step = other.middle - a.middle
        along, aside = float(step @ a.heading), abs(float(a.heading[0] * step[1] - a.heading[1] * step[0]))
        straight = float(-other.heading @ a.heading) > np.cos(_STRAIGHT_RAD)
        if other is not a and other is not b and straight and 0.1 < along < gap - 1.0 and aside <= _MAX_SHIFT_M:
            return True
    return False


def _has_outer(ends: list[_LaneEnd], a: _LaneEnd, on_left: bool, outward: bool) -> bool:
    """Return whether a lane beside a, on one hand of who leaves there, is open the same way."""
    shared = a.left if on_left else a.right
    return any(
        other is not a
        and shared in (other.left, other.right)
        and float(other.heading @ a.heading) > 0
        and (other.leads_out if outward else other.leads_in)
        for other in ends
    )


def _add_curve(
    graph: LaneGraph,
    known: dict[tuple[Key, Key], int],
    side: tuple[Key, Key, bool],
    geometry: tuple[Floats, Floats, Floats, Floats],
) -> tuple[int, bool]:
    """Return the number of a curve between two points, and whether it runs the other way.

    side: both points, and whether the curve is the left side of its connection. geometry: place and tangent of each point. A
    curve is shared with what lies on its other hand.
    """
    first, last, is_left = side
    for key, is_reversed in (((first, last), False), ((last, first), True)):
        if key in known and not graph.is_taken(known[key], is_left, is_reversed):
            return known[key], is_reversed
    start, start_heading, end, end_heading = geometry
    handle = _HANDLE * float(np.hypot(*(end - start)))
    t = np.linspace(0.0, 1.0, _CURVE_POINTS)[:, None]
    one, two = start + handle * start_heading, end - handle * end_heading
    curve = (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * one + 3 * (1 - t) * t**2 * two + t**3 * end
    known[first, last] = len(graph.pieces)
    graph.pieces.append(Piece(curve, first, last))
    return len(graph.pieces) - 1, False
