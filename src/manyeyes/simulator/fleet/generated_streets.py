# SPDX-License-Identifier: Apache-2.0
"""Generated streets: a lattice of crossroads whose truth and lanes are known by construction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, DOUBLE, NO_STYLE, STOP_LINE, MapElements
from manyeyes.simulator.fleet.routes import Routes

Array = NDArray[np.float64]

LANE_M = 3.5
_CORNER_M = 6.0
_STEP_M = 1.0
_EAST, _NORTH, _WEST, _SOUTH = range(4)
_TURN = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


@dataclass(frozen=True)
class StreetPlan:
    """A lattice of columns × rows crossroads, block_m apart, whose outer arms reach arm_m beyond.

    lanes: in each direction. warp_m: the amplitude of a smooth bending of the whole plan, which is turned by turn_rad.
    """

    columns: int = 1
    rows: int = 1
    block_m: float = 150.0
    arm_m: float = 145.0
    lanes: int = 3
    warp_m: float = 0.0
    turn_rad: float = 0.0

    @property
    def half_m(self) -> float:
        """Half of a street's width."""
        return self.lanes * LANE_M

    @property
    def mouth_m(self) -> float:
        """From a crossroads' middle to where its arms begin."""
        return self.half_m + _CORNER_M

    def to_local(self, points: Array) -> Array:
        """Plan coordinates (M, 2) as metres about the middle of the plan, bent and turned."""
        middle = np.array([(self.columns - 1) * self.block_m, (self.rows - 1) * self.block_m]) / 2
        x, y = (points - middle).T
        bent = np.stack((x + self.warp_m * np.sin(y / 190.0), y + self.warp_m * np.sin(x / 230.0 + 1.0)), 1)
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return bent @ np.array([[c, s], [-s, c]])


def street_truth(plan: StreetPlan) -> MapElements:
    """Return the elements of a plan: per street dashed dividers and a double middle, edges, corners, crossings and stop lines."""
    lines: list[tuple[int, int, Array]] = []
    for node in _nodes(plan):
        for way in range(4):
            lines += _at_mouth(plan, node, way)
    for start, way, length in _streets(plan):
        for k in range(-plan.lanes, plan.lanes + 1):
            kind = BOUNDARY if abs(k) == plan.lanes else DIVIDER
            style = NO_STYLE if kind == BOUNDARY else DOUBLE if k == 0 else DASHED
            stations = np.arange(0.0, length + _STEP_M / 2, _STEP_M)
            stations = np.append(stations[stations < length - 1e-6], length)
            lines.append((kind, style, start + stations[:, None] * _TURN[way] + k * LANE_M * _TURN[(way + 1) % 4]))
    placed = [(kind, style, canonical_points(kind, plan.to_local(points))) for kind, style, points in lines]
    placed.sort(key=lambda row: (row[0], *np.round(row[2][0], 6).tolist(), *np.round(row[2][-1], 6).tolist()))
    return MapElements.of(
        [row[2] for row in placed], [row[0] for row in placed], sigma=0.0, style=[row[1] for row in placed]
    )


def street_routes(plan: StreetPlan) -> Routes:
    """Return the lanes of a plan, driven on the right, and how they lead through the crossroads."""
    lanes: list[Array] = []
    arriving: dict[tuple[int, int, int], list[int]] = {}
    leaving: dict[tuple[int, int, int], list[int]] = {}
    nodes = _nodes(plan)
    for start, way, length in _streets(plan):
        end = start + length * _TURN[way]
        for a, b, heading in ((start, end, way), (end, start, (way + 2) % 4)):
            row = []
            for k in range(plan.lanes):
                right = -(k + 0.5) * LANE_M * _TURN[(heading + 1) % 4]
                row.append(len(lanes))
                lanes.append(_straight(a + right, b + right))
            for at, table in ((a, leaving), (b, arriving)):
                node = _node_at(plan, at, heading if table is arriving else (heading + 2) % 4)
                if node in nodes:
                    table[(*node, heading)] = row
    successors: list[tuple[int, int]] = []
    for (i, j, heading), rows in sorted(arriving.items()):
        for turn, own, other in ((0, range(plan.lanes), range(plan.lanes)), (1, (0,), (0,)), (3, (-1,), (-1,))):
            out = leaving.get((i, j, (heading + turn) % 4))
            if out is None:
                continue
            for a, b in zip(own, other):
                number = len(lanes)
                lanes.append(_bend(lanes[rows[a]], lanes[out[b]]))
                successors += [(rows[a], number), (number, out[b])]
    return Routes.of([plan.to_local(lane) for lane in lanes], successors)


def street_junctions(plan: StreetPlan) -> list[Array]:
    """Return (8, 2) rings, the ground of each crossroads."""
    h, w = plan.mouth_m, plan.half_m
    ring = np.array([[h, -w], [h, w], [w, h], [-w, h], [-h, w], [-h, -w], [-w, -h], [w, -h]])
    return [plan.to_local(np.array(node) * plan.block_m + ring) for node in _nodes(plan)]


def _nodes(plan: StreetPlan) -> list[tuple[int, int]]:
    return [(i, j) for i in range(plan.columns) for j in range(plan.rows)]


def _streets(plan: StreetPlan) -> list[tuple[Array, int, float]]:
    """Start, heading and length of each street between two mouths, or from a mouth to the plan's end."""
    found = []
    for i, j in _nodes(plan):
        middle = np.array([i, j], np.float64) * plan.block_m
        for way in range(4):
            di, dj = _TURN[way].astype(int)
            inner = 0 <= i + di < plan.columns and 0 <= j + dj < plan.rows
            if inner and way in (_WEST, _SOUTH):
                continue
            length = plan.block_m - 2 * plan.mouth_m if inner else plan.arm_m - plan.mouth_m
            found.append((middle + plan.mouth_m * _TURN[way], way, length))
    return found


def _node_at(plan: StreetPlan, mouth: Array, heading: int) -> tuple[int, int]:
    """Return the crossroads whose mouth lies at a point, seen along a heading."""
    i, j = np.round((mouth + plan.mouth_m * _TURN[heading]) / plan.block_m, 3)
    return (int(i), int(j)) if i == int(i) and j == int(j) else (-1, -1)


def _at_mouth(plan: StreetPlan, node: tuple[int, int], way: int) -> list[tuple[int, int, Array]]:
    """Return the crossing, the stop line and the corner on the left of one arm."""
    middle, out, left = np.array(node, np.float64) * plan.block_m, _TURN[way], _TURN[(way + 1) % 4]
    w, h = plan.half_m, plan.mouth_m

    def at(longitudinal: float, lateral: float) -> Array:
        return middle + longitudinal * out + lateral * left

    ring = np.array([at(h - 4.5, -w), at(h - 0.5, -w), at(h - 0.5, w), at(h - 4.5, w)])
    stop = np.array([at(h + 1.0, 0.2), at(h + 1.0, w - 0.2)])
    angle = np.linspace(0.0, np.pi / 2, 9)
    corner = np.array([at(h - _CORNER_M * np.sin(a), h - _CORNER_M * np.cos(a)) for a in angle])
    return [(CROSSING, NO_STYLE, ring), (STOP_LINE, NO_STYLE, stop), (BOUNDARY, NO_STYLE, corner)]


def canonical_points(kind: int, points: Array) -> Array:
    """Return rings from their smallest corner, lines from their smaller end."""
    if kind == CROSSING:
        return np.roll(points, -int(np.lexsort(points.T[::-1])[0]), axis=0)
    return points if tuple(points[0]) <= tuple(points[-1]) else points[::-1]


def _straight(a: Array, b: Array) -> Array:
    count = max(2, int(np.ceil(np.linalg.norm(b - a) / _STEP_M)) + 1)
    return a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)


def _bend(before: Array, after: Array) -> Array:
    """From a lane's end to another's start, leaving and arriving in their directions (a quadratic Bézier curve)."""
    a, b = before[-1], after[0]
    u, v = before[-1] - before[-2], after[1] - after[0]
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) < 1e-9:
        return _straight(a, b)
    corner = a + u * ((b[0] - a[0]) * v[1] - (b[1] - a[1]) * v[0]) / cross
    t = np.linspace(0.0, 1.0, 13)[:, None]
    return (1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b
