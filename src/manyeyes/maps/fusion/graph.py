# SPDX-License-Identifier: Apache-2.0
"""Sparse geometric graph of map elements as arrays: nodes are elements of maps and observations, edges their relations.

CrowdMap 2.3 makes elements nodes and "spatial or semantic relations" edges, and defines neither; the relations here are this
project's. Two lines face each other where the foot of a point of one lies inside the other and their directions differ by
little. Over such an interval the lateral offset has a mean and a median absolute deviation.

overlap: of one class, facing each other at a small offset.
parallel: lines that face each other at a lane's distance.
continues: of one class, an end ahead of an end.
crosses: they intersect at an angle.
same_observation: from one observation; if such elements face each other apart, they are distinct
    (:attr:`ElementGraph.cannot_link`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, I64x2, njit
from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.datatypes.map_element import MapElements, freeze
from manyeyes.ops.polyline import close_rings, find_near_pairs, headings, resample_spaced

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RELATIONS = ("overlap", "continues", "parallel", "crosses", "same_observation")
OVERLAP, CONTINUES, PARALLEL, CROSSES, SAME_OBSERVATION = range(len(RELATIONS))
# Columns of what is measured of a pair, in the order in which the compiled loop writes them.
_START_I, _END_I, _START_J, _END_J, _MEAN, _SPREAD, _COUNT, _CROSS_I, _CROSS_J, _CROSS_TURN, _GAP, _GAP_TURN, _ENDS = (
    range(13)
)
_NUM_COLUMNS = 13


@dataclass(frozen=True)
class GraphConfig:
    """Configuration of the graph, in metres and radians.

    spacing_m: distance of the compared points. max_turn_rad: largest angle between lines that face each other.
    max_overlap_offset_m: largest mean offset of an overlap; max_parallel_offset_m: of a parallel.
    min_interval_m: shortest interval of either, or half of the shorter element.
    max_gap_m, max_gap_turn_rad: of ends that continue; their lateral offset is at most max_lateral_m + lateral_slope times the
        gap.
    min_crossing_angle_rad: smallest angle of a crossing.
    min_separation_m: offset from which elements of one observation are distinct.
    """

    spacing_m: float = 1.0
    max_turn_rad: float = math.radians(20.0)
    max_overlap_offset_m: float = 1.2
    max_parallel_offset_m: float = 6.0
    min_interval_m: float = 5.0
    max_gap_m: float = 6.0
    max_gap_turn_rad: float = math.radians(15.0)
    max_lateral_m: float = 0.25
    lateral_slope: float = 0.08
    min_crossing_angle_rad: float = math.radians(20.0)
    min_separation_m: float = 1.0


@dataclass(frozen=True, eq=False)
class ElementGraph:
    """E relations of N nodes, ordered by relation, then rows.

    nodes: the elements, map's frame. observation: (N,) which one saw each, -1: an element of a map. edge: (E, 2) rows i < j.
    relation: (E,) index into RELATIONS. interval: (E, 4) metres along i from, to, and along j from, to, where they face each
    other or cross; NaN: nowhere. lateral, spread: (E,) mean offset of j on i's left hand, metres, and its median absolute
    deviation. gap: (E,) metres between ends that continue. turn: (E,) radians between directions, [0, pi / 2]. ends: (E, 2)
    which end of i and of j continue each other, 0 its first point, 1 its last; -1: none.
    """

    nodes: MapElements
    observation: Ints
    edge: Ints
    relation: Ints
    interval: Floats
    lateral: Floats
    spread: Floats
    gap: Floats
    turn: Floats
    ends: Ints
    min_separation_m: float

    def __len__(self) -> int:
        return len(self.edge)

    def select_relation(self, relation: str) -> ElementGraph:
        """Return the edges of one relation."""
        if relation not in RELATIONS:
            raise ConfigError(
                f"ElementGraph: expected a relation of {', '.join(RELATIONS)}; got {relation!r}. Choose one."
            )
        chosen = self.relation == RELATIONS.index(relation)
        kept = {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if f.name in ("nodes", "observation", "min_separation_m")
        }
        return ElementGraph(
            **kept, **{f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name not in kept}
        )

    @property
    def cannot_link(self) -> NDArray[np.bool_]:
        """(E,) pairs of one observation that face each other farther apart than one thing is wide."""
        return (self.relation == SAME_OBSERVATION) & (np.abs(self.lateral) > self.min_separation_m)


def build_element_graph(
    nodes: MapElements, observation: ArrayLike = -1, config: GraphConfig = GraphConfig()
) -> ElementGraph:
    """Return the graph of elements in one frame; observation: (N,) or one for all, -1 for elements of a map."""
    owner = np.array(np.broadcast_to(np.asarray(observation, np.int64), (len(nodes),)))
    if len(nodes) and int(nodes.counts.min()) < 2:
        raise ShapeError(
            "build_element_graph needs elements of two points or more; got fewer: take those with counts > 1."
        )
    pairs = find_near_pairs(nodes.bounds(), max(config.max_parallel_offset_m, config.max_gap_m))
    points, offsets = close_rings(nodes.points, nodes.offsets, nodes.closed)
    dense, dense_first = resample_spaced(points, offsets, config.spacing_m)
    lines = _Polylines(freeze(points, np.float64), freeze(offsets, np.int64))
    samples = _Samples(freeze(dense, np.float64), freeze(dense_first, np.int64), headings(dense, dense_first))
    found = _measure_pairs(lines, samples, freeze(pairs, np.int64), nodes.closed, _Thresholds.of(config))
    return _classify(nodes, owner, pairs, found, config)


def _classify(nodes: MapElements, owner: Ints, pairs: Ints, found: Floats, config: GraphConfig) -> ElementGraph:
    """Return the edges that the measurements (K, _NUM_COLUMNS) of pairs (K, 2) make."""
    i, j = pairs.T
    length = nodes.lengths()
    min_interval = np.minimum(config.min_interval_m, 0.5 * np.minimum(length[i], length[j]))
    facing = (found[:, _COUNT] >= 2) & (found[:, _END_I] - found[:, _START_I] >= min_interval)
    offset = np.abs(found[:, _MEAN])
    same_kind = nodes.kind[i] == nodes.kind[j]
    lines = ~nodes.closed[i] & ~nodes.closed[j]
    overlap = facing & same_kind & (offset <= config.max_overlap_offset_m)
    of_one = (owner[i] == owner[j]) & (owner[i] >= 0)
    chosen = {
        OVERLAP: overlap,
        CONTINUES: same_kind & lines & ~overlap & np.isfinite(found[:, _GAP]),
        PARALLEL: facing & lines & (offset > config.max_overlap_offset_m) & (offset <= config.max_parallel_offset_m),
        CROSSES: np.isfinite(found[:, _CROSS_I]),
        SAME_OBSERVATION: of_one,
    }
    rows = np.concatenate([np.flatnonzero(chosen[k]) for k in range(len(RELATIONS))]).astype(np.int64)
    relation = np.repeat(np.arange(len(RELATIONS)), [int(chosen[k].sum()) for k in range(len(RELATIONS))])
    held = found[rows]
    sides = np.isin(relation, (OVERLAP, PARALLEL, SAME_OBSERVATION)) & facing[rows]
    crossing, continuing = relation == CROSSES, relation == CONTINUES
    interval = np.where(sides[:, None], held[:, [_START_I, _END_I, _START_J, _END_J]], np.nan)
    interval = np.where(crossing[:, None], held[:, [_CROSS_I, _CROSS_I, _CROSS_J, _CROSS_J]], interval)
    ends = np.where(continuing, held[:, _ENDS], -1).astype(np.int64)
    turn = np.where(crossing, held[:, _CROSS_TURN], np.where(continuing, held[:, _GAP_TURN], np.nan))
    return ElementGraph(
        nodes=nodes,
        observation=owner,
        edge=pairs[rows],
        relation=relation,
        interval=interval,
        lateral=np.where(sides, held[:, _MEAN], np.nan),
        spread=np.where(sides, held[:, _SPREAD], np.nan),
        gap=np.where(continuing, held[:, _GAP], np.nan),
        turn=turn,
        ends=np.where(ends[:, None] >= 0, np.stack((ends // 2, ends % 2), 1), -1),
        min_separation_m=config.min_separation_m,
    )


class _Polylines(NamedTuple):
    """N polylines: line i is ``points[first[i]:first[i + 1]]``; rings are closed."""

    points: F64x2
    first: I64x1


class _Samples(NamedTuple):
    """The same at equal spacing: line i is ``points[first[i]:first[i + 1]]``; heading: (P,) rad of each point."""

    points: F64x2
    first: I64x1
    heading: F64x1


class _Thresholds(NamedTuple):
    """The bounds of GraphConfig that decide on pairs, all as floats; metres and radians."""

    max_facing_turn: float
    max_gap_m: float
    max_gap_turn: float
    max_lateral_m: float
    lateral_slope: float
    min_cross_turn: float

    @classmethod
    def of(cls, config: GraphConfig) -> _Thresholds:
        bounds = (
            config.max_turn_rad,
            config.max_gap_m,
            config.max_gap_turn_rad,
            config.max_lateral_m,
            config.lateral_slope,
            config.min_crossing_angle_rad,
        )
        return cls(*(float(bound) for bound in bounds))


@njit(cache=True)
def _measure_pairs(
    lines: _Polylines, samples: _Samples, pairs: I64x2, closed: Boolx1, params: _Thresholds
) -> F64x2:  # pragma: no cover - compiled
    """Return (K, _NUM_COLUMNS) what is measured of each pair; infinity where two ends do not continue or two lines do not
    cross.
    """
    points, offsets = lines
    dense, dense_first, heading = samples
    out = np.full((len(pairs), _NUM_COLUMNS), np.inf)
    out[:, :_CROSS_I] = 0.0
    for k in range(len(pairs)):
        i, j = pairs[k]
        line = points[offsets[j] : offsets[j + 1]]
        _face(
            dense[dense_first[i] : dense_first[i + 1]],
            heading[dense_first[i] : dense_first[i + 1]],
            line,
            params.max_facing_turn,
            out[k],
        )
        _cross(points[offsets[i] : offsets[i + 1]], line, params.min_cross_turn, out[k])
        if not closed[i] and not closed[j]:
            _continue(points[offsets[i] : offsets[i + 1]], line, params, out[k])
    return out


@njit(cache=True)
def _angle_between(ax: float, ay: float, bx: float, by: float) -> float:  # pragma: no cover - compiled
    """Return the angle between two directions without regard to sense, [0, pi / 2]."""
    return np.arctan2(abs(ax * by - ay * bx), abs(ax * bx + ay * by))


@njit(cache=True)
def _face(
    dense: F64x2, heading: F64x1, line: F64x2, max_turn: float, out: F64x1
) -> None:  # pragma: no cover - compiled
    """Interval and offset of the points whose foot lies inside the line, under a like direction."""
    n = len(dense)
    lateral = np.empty(n)
    count, passed_i = 0, 0.0
    for p in range(n):
        if p > 0:
            passed_i += np.hypot(dense[p, 0] - dense[p - 1, 0], dense[p, 1] - dense[p - 1, 1])
        x, y = dense[p]
        cx, cy = np.cos(heading[p]), np.sin(heading[p])
        best, side, at, passed = np.inf, 0.0, 0.0, 0.0
        for q in range(len(line) - 1):
            dx, dy = line[q + 1, 0] - line[q, 0], line[q + 1, 1] - line[q, 1]
            squared = dx * dx + dy * dy
            if squared == 0.0:
                continue
            length = np.sqrt(squared)
            share = ((x - line[q, 0]) * dx + (y - line[q, 1]) * dy) / squared
            held = min(max(share, 0.0), 1.0)
            ex, ey = line[q, 0] + held * dx - x, line[q, 1] + held * dy - y
            gap = ex * ex + ey * ey
            beyond = (q == 0 and share < -1e-9) or (q == len(line) - 2 and share > 1.0 + 1e-9)
            if gap < best:
                best = gap
                if beyond or _angle_between(cx, cy, dx, dy) > max_turn:
                    side = np.inf
                else:
                    side = np.sqrt(gap) if cx * ey - cy * ex >= 0.0 else -np.sqrt(gap)
                    at = passed + held * length
            passed += length
        if np.isfinite(best) and np.isfinite(side):
            if count == 0:
                out[_START_I], out[_START_J], out[_END_J] = passed_i, at, at
            out[_END_I] = passed_i
            out[_START_J], out[_END_J] = min(out[_START_J], at), max(out[_END_J], at)
            lateral[count] = side
            count += 1
    out[_COUNT] = count
    if count > 0:
        found = lateral[:count]
        out[_MEAN] = found.mean()
        out[_SPREAD] = np.median(np.abs(found - np.median(found)))


@njit(cache=True)
def _cross(one: F64x2, two: F64x2, min_turn: float, out: F64x1) -> None:  # pragma: no cover - compiled
    """Where along both they first intersect at an angle."""
    passed_i = 0.0
    for p in range(len(one) - 1):
        ax, ay = one[p + 1, 0] - one[p, 0], one[p + 1, 1] - one[p, 1]
        length_i, passed_j = np.hypot(ax, ay), 0.0
        for q in range(len(two) - 1):
            bx, by = two[q + 1, 0] - two[q, 0], two[q + 1, 1] - two[q, 1]
            length_j = np.hypot(bx, by)
            across = ax * by - ay * bx
            if across != 0.0 and _angle_between(ax, ay, bx, by) >= min_turn:
                ox, oy = two[q, 0] - one[p, 0], two[q, 1] - one[p, 1]
                s, t = (ox * by - oy * bx) / across, (ox * ay - oy * ax) / across
                if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
                    out[_CROSS_I], out[_CROSS_J] = passed_i + s * length_i, passed_j + t * length_j
                    out[_CROSS_TURN] = _angle_between(ax, ay, bx, by)
                    return
            passed_j += length_j
        passed_i += length_i


@njit(cache=True)
def _continue(one: F64x2, two: F64x2, params: _Thresholds, out: F64x1) -> None:  # pragma: no cover - compiled
    """The nearest pair of ends of which each lies ahead of the other."""
    for end_i in range(2):
        a, before = (len(one) - 1, len(one) - 2) if end_i else (0, 1)
        ux, uy = one[a, 0] - one[before, 0], one[a, 1] - one[before, 1]
        norm_u = np.hypot(ux, uy)
        for end_j in range(2):
            b, inner = (len(two) - 1, len(two) - 2) if end_j else (0, 1)
            vx, vy = two[b, 0] - two[inner, 0], two[b, 1] - two[inner, 1]
            norm_v = np.hypot(vx, vy)
            gx, gy = two[b, 0] - one[a, 0], two[b, 1] - one[a, 1]
            gap = np.hypot(gx, gy)
            if norm_u == 0.0 or norm_v == 0.0 or gap > params.max_gap_m or gap >= out[_GAP]:
                continue
            ahead = (gx * ux + gy * uy) / norm_u
            aside = abs(gx * uy - gy * ux) / norm_u
            turn = _angle_between(ux, uy, vx, vy)
            # Two ends may have passed each other by as much as a line's own spread.
            if (
                ux * vx + uy * vy < 0.0
                and turn < params.max_gap_turn
                and aside <= params.max_lateral_m + params.lateral_slope * gap
                and ahead >= -0.5
            ):
                out[_GAP], out[_GAP_TURN], out[_ENDS] = gap, turn, 2 * end_i + end_j
