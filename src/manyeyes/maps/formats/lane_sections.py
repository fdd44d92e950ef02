# SPDX-License-Identifier: Apache-2.0
"""Lanes of a map as sections that share their sides and ends, for formats whose lanes form a graph.

Lines that bound a lane (:mod:`manyeyes.maps.formats.lanes`) are cut where a line beside them ends, so that a section of a lane
lies between one piece of each line. Neighbouring sections share the piece between them, following ones the two points where
they meet.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.lanes import MAX_WIDTH_M, MIN_WIDTH_M, LanePair, find_lane_pairs

Floats = NDArray[np.float64]

# Ends of two lines that differ by less, along the lane, are ends of one cross-section.
_SAME_CUT_M = 6.0
_MAX_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a line of the map (row; -1: of none): points (M, 2), and keys of its first and last point, equal where shared."""

    points: Floats
    first: tuple[int, int]
    last: tuple[int, int]
    row: int = -1


@dataclass(frozen=True, eq=False)
class LaneSection:
    """A section of a lane between two pieces; left and right: their numbers, both along the section if not reversed.

    lane: number of the lane that it is a section of; -1 for a connection. direction: 1 along the section, -1 against it, 0
    unknown.
    """

    left: int
    right: int
    left_reversed: bool
    right_reversed: bool
    lane: int
    direction: int = 0


@dataclass
class LaneGraph:
    """Pieces by number, and sections of lanes between them."""

    pieces: list[Piece] = field(default_factory=list)
    sections: list[LaneSection] = field(default_factory=list)
    _taken: set[tuple[int, bool]] = field(default_factory=set)

    def is_taken(self, piece: int, is_left: bool, is_reversed: bool) -> bool:
        """Return whether a section lies already on that hand of a piece, of which it would be the left or right side."""
        return (piece, is_left != is_reversed) in self._taken

    def add_section(self, section: LaneSection) -> None:
        """Add a section, unless another lies on the same hand of one of its sides."""
        hands = [(section.left, True, section.left_reversed), (section.right, False, section.right_reversed)]
        if not any(self.is_taken(*hand) for hand in hands):
            self._taken |= {(piece, is_left != is_reversed) for piece, is_left, is_reversed in hands}
            self.sections.append(section)

    def side(self, section: LaneSection, left: bool) -> Floats:
        """Return one side (M, 2) of a section, along it."""
        number, turned = (section.left, section.left_reversed) if left else (section.right, section.right_reversed)
        points = self.pieces[number].points
        return points[::-1] if turned else points

    def ends(self, section: LaneSection, at_end: bool) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the keys of the left and right point at the start or the end of a section."""
        left, right = self.pieces[section.left], self.pieces[section.right]
        return (
            left.last if at_end != section.left_reversed else left.first,
            right.last if at_end != section.right_reversed else right.first,
        )

    def heading_outward(self, section: LaneSection, at_end: bool) -> Floats:
        """Return the unit direction (2,) in which a section is left at its start or its end."""
        axis = self.middle_line(section)
        step = axis[-1] - axis[-2] if at_end else axis[0] - axis[1]
        return step / max(float(np.hypot(*step)), 1e-9)

    def middle_line(self, section: LaneSection, count: int = 12) -> Floats:
        """Return (count, 2) points between both sides, along the section."""
        return (_resample(self.side(section, True), count) + _resample(self.side(section, False), count)) / 2


def build_lane_sections(vector_map: VectorMap) -> LaneGraph:
    """Return the sections of all lanes, and the pieces of all open lines of a map."""
    e = vector_map.elements
    pairs = find_lane_pairs(vector_map)
    lines = {row: _Line(e.polyline(row)) for row in np.flatnonzero(~e.closed).tolist()}
    for _ in range(_MAX_ROUNDS):
        if not sum(_add_cuts(lines[a], lines[b]) for p in pairs for a, b in ((p.left, p.right), (p.right, p.left))):
            break
    graph = LaneGraph()
    numbers: dict[tuple[int, int], int] = {}
    for row, line in lines.items():
        for k in range(len(line.cuts) - 1):
            numbers[row, k] = len(graph.pieces)
            graph.pieces.append(Piece(line.piece(k), (row, k), (row, k + 1), row))
    for lane, pair in enumerate(pairs):
        for section in _sections_of_pair(lines, pair, lane, numbers):
            graph.add_section(section)
    _merge_facing_ends(graph)
    return graph


def _merge_facing_ends(graph: LaneGraph) -> None:
    """Make one point of the last point of a line and the first one of the next where both are ends of one cross-section."""
    by_key: dict[tuple[int, int], list[tuple[int, bool]]] = {}
    for number, section in enumerate(graph.sections):
        for at_end in (False, True):
            for key in graph.ends(section, at_end):
                by_key.setdefault(key, []).append((number, at_end))
    for key in sorted(by_key):
        for (i, at_end), (j, other_at_end) in combinations(by_key[key], 2):
            one, other = (graph.ends(graph.sections[n], at) for n, at in ((i, at_end), (j, other_at_end)))
            if key not in one or key not in other or set(one) == set(other):
                continue
            (a,), (b,) = set(one) - {key}, set(other) - {key}
            outward = [graph.heading_outward(graph.sections[n], at) for n, at in ((i, at_end), (j, other_at_end))]
            if float(outward[0] @ outward[1]) < 0 and _is_end_of_line(graph, a) and _is_end_of_line(graph, b):
                _merge_points(graph, a, b)


def _is_end_of_line(graph: LaneGraph, key: tuple[int, int]) -> bool:
    """Return whether one piece alone begins or ends at a point."""
    return sum(key == piece.first for piece in graph.pieces) + sum(key == piece.last for piece in graph.pieces) == 1


def _merge_points(graph: LaneGraph, a: tuple[int, int], b: tuple[int, int]) -> None:
    """Move the ends of two lines to their middle, if they are near each other, and give both one key."""
    ends = [
        (number, is_last)
        for number, piece in enumerate(graph.pieces)
        for is_last, key in ((False, piece.first), (True, piece.last))
        if key in (a, b)
    ]
    places = np.array([graph.pieces[number].points[-1 if is_last else 0] for number, is_last in ends])
    if float(np.hypot(*(places[0] - places[-1]))) > 2 * _SAME_CUT_M:
        return
    for number, is_last in ends:
        piece = graph.pieces[number]
        points = piece.points.copy()
        points[-1 if is_last else 0] = places.mean(0)
        changed = {"last": min(a, b)} if is_last else {"first": min(a, b)}
        graph.pieces[number] = replace(piece, points=points, **changed)


class _Line:
    """A line (M, 2) with the distances along it at which it is cut, its ends among them."""

    def __init__(self, points: Floats) -> None:
        self.points = points
        self.along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        self.cuts = [0.0, float(self.along[-1])]

    def at(self, distance: float) -> Floats:
        """Return the point (2,) at a distance along the line."""
        return np.array([np.interp(distance, self.along, self.points[:, k]) for k in (0, 1)])

    def piece(self, k: int) -> Floats:
        """Return the points between cuts k and k + 1."""
        a, b = self.cuts[k], self.cuts[k + 1]
        inner = self.points[(self.along > a + 1e-6) & (self.along < b - 1e-6)]
        return np.concatenate((self.at(a)[None], inner, self.at(b)[None]))

    def project(self, point: Floats) -> tuple[float, float]:
        """Return the distance along the line of its point nearest to a point (2,), and how far that is."""
        start, step = self.points[:-1], np.diff(self.points, axis=0)
        share = (((point - start) * step).sum(1) / np.maximum((step**2).sum(1), 1e-18)).clip(0.0, 1.0)
        gap = np.hypot(*(point - start - share[:, None] * step).T)
        k = int(gap.argmin())
        return float(self.along[k] + share[k] * (self.along[k + 1] - self.along[k])), float(gap[k])

    def nearest_cut(self, distance: float) -> int:
        """Return the number of the cut nearest to a distance along the line."""
        return int(np.abs(np.array(self.cuts) - distance).argmin())


def _is_lane_width(gap: float) -> bool:
    return 0.8 * MIN_WIDTH_M <= gap <= 1.2 * MAX_WIDTH_M


def _add_cuts(line: _Line, other: _Line) -> int:
    """Cut another line where a line beside it is cut; return how many cuts were added."""
    added = 0
    for cut in line.cuts:
        at, gap = other.project(line.at(cut))
        if _is_lane_width(gap) and abs(other.cuts[other.nearest_cut(at)] - at) > _SAME_CUT_M:
            other.cuts = sorted([*other.cuts, at])
            added += 1
    return added


def _sections_of_pair(
    lines: dict[int, _Line], pair: LanePair, lane: int, numbers: dict[tuple[int, int], int]
) -> list[LaneSection]:
    """Return the sections between two lines, along the left one."""
    left, right = lines[pair.left], lines[pair.right]
    out = []
    for k in range(len(left.cuts) - 1):
        a, b = left.cuts[k], left.cuts[k + 1]
        (start, _), (end, _), (_, gap) = (right.project(left.at(s)) for s in (a, b, (a + b) / 2))
        i, j = right.nearest_cut(start), right.nearest_cut(end)
        apart = max(abs(right.cuts[i] - start), abs(right.cuts[j] - end))
        if abs(i - j) == 1 and (i > j) == pair.right_is_reversed and apart <= _SAME_CUT_M and _is_lane_width(gap):
            piece = numbers[pair.right, min(i, j)]
            out.append(LaneSection(numbers[pair.left, k], piece, False, pair.right_is_reversed, lane))
    return out


def _resample(line: Floats, count: int) -> Floats:
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, line[:, k]) for k in (0, 1)], 1)
