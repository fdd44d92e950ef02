# SPDX-License-Identifier: Apache-2.0
"""Many polylines at once: resampling, lengths, headings, feet, and which of them lie near each other.

Lines are columns: points (P, 2) metres and first (N+1,) offsets, line i being ``points[first[i]:first[i + 1]]``; a ring is
given closed (:func:`close_rings`). Distances between lines stand in :mod:`manyeyes.ops.polyline_distance`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, I64x2, njit, set_row
from manyeyes.datatypes.map_element import freeze, take_rows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_SAMPLES = 2000


def close_rings(points: Floats, offsets: Ints, closed: NDArray[np.bool_]) -> tuple[Floats, Ints]:
    """Return the same lines, those marked closed (N,) with their first point repeated at the end."""
    counts = np.diff(offsets)
    more = (closed & (counts > 0)).astype(np.int64)
    out_offsets = np.concatenate(([0], np.cumsum(counts + more))).astype(np.int64)
    out = np.empty((int(out_offsets[-1]), 2))
    _, places = take_rows(out_offsets, np.arange(len(counts)))
    row = np.repeat(np.arange(len(counts)), counts + more)
    k = places - out_offsets[row]
    out[places] = points[offsets[row] + np.where(k == counts[row], 0, k)]
    return out, out_offsets


def lengths(points: Floats, offsets: Ints) -> Floats:
    """Return (N,) metres along each line."""
    row = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    if len(points) < 2:
        return np.zeros(len(offsets) - 1)
    step = np.hypot(*np.diff(points, axis=0).T)
    step[row[1:] != row[:-1]] = 0.0
    return np.bincount(row[1:], step, len(offsets) - 1).astype(np.float64)


def resample(points: Floats, offsets: Ints, counts: ArrayLike) -> tuple[Floats, Ints]:
    """Return each line at so many points, one number or (N,), of equal arc length, both its ends included."""
    wanted = np.broadcast_to(np.asarray(counts, np.int64), (len(offsets) - 1,))
    wanted = np.where(np.diff(offsets) > 0, wanted, 0)
    target = freeze(np.concatenate(([0], np.cumsum(wanted))), np.int64)
    return _resample(freeze(points, np.float64), freeze(offsets, np.int64), target), target


def resample_spaced(
    points: Floats, offsets: Ints, spacing_m: float, max_samples: int = MAX_SAMPLES
) -> tuple[Floats, Ints]:
    """Return each line at equal steps of at most spacing_m, both ends included, but at no more than so many points."""
    steps = np.ceil(lengths(points, offsets) / spacing_m - 1e-9).astype(np.int64)
    return resample(points, offsets, np.clip(steps + 1, 2, max_samples))


def headings(points: Floats, offsets: Ints) -> Floats:
    """Return (P,) radians in [-pi, pi], the direction from the point before to the point after; one-sided at the ends."""
    p = len(points)
    if p == 0:
        return np.zeros(0)
    row = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    before = np.maximum(np.arange(p) - 1, offsets[:-1][row])
    after = np.minimum(np.arange(p) + 1, offsets[1:][row] - 1)
    step = points[after] - points[before]
    return np.arctan2(step[:, 1], step[:, 0])


@dataclass(frozen=True)
class LineProjection:
    """The nearest place on a line to each query: along (Q,) metres from its start; side (Q,) metres, left of it positive.

    distance_m: (Q,) metres to the foot; is_interior: (Q,) whether the foot is neither of the line's ends.
    """

    station_m: Floats
    lateral_m: Floats
    distance_m: Floats
    is_interior: NDArray[np.bool_]


def project_onto_line(queries: Floats, line: Floats) -> LineProjection:
    """Where each query (Q, 2) stands beside one line (K, 2), K >= 2; of equally near places the first."""
    return LineProjection(*_project_onto_line(freeze(queries, np.float64), freeze(line, np.float64)))


def points_at_stations(line: Floats, station_m: ArrayLike) -> Floats:
    """Return (Q, 2) the points of a line (K, 2) at these metres from its start; beyond its ends, the ends."""
    passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    return np.stack([np.interp(np.asarray(station_m, np.float64), passed, line[:, k]) for k in range(2)], -1)


def cut_line(line: Floats, start_m: float, end_m: float) -> Floats:
    """Return (K', 2) the part of a line between two stations, its own vertices between them kept."""
    passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    start_m, end_m = max(start_m, 0.0), min(end_m, float(passed[-1]))
    inner = line[(passed > start_m + 1e-9) & (passed < end_m - 1e-9)]
    ends = points_at_stations(line, [start_m, end_m])
    return np.concatenate((ends[:1], inner, ends[1:]))


def simplify(line: Floats, tolerance_m: float) -> Floats:
    """Return (K', 2) by Douglas and Peucker (1973): no point left out lies farther than the tolerance from what stays."""
    return line[select_vertices(line, tolerance_m)]


def select_vertices(line: Floats, tolerance_m: float) -> NDArray[np.bool_]:
    """Return (K,) which vertices of a line (K, 2) stay when it is simplified; both ends do."""
    return _simplify(freeze(line, np.float64), tolerance_m)


def find_near_pairs(bounds: Floats, max_gap_m: float) -> Ints:
    """Return (K, 2) pairs of rows i < j, ascending, whose boxes (N, 4) are at most max_gap_m apart along both axes."""
    boxes = np.array(bounds, np.float64)
    boxes[:, :2] -= max_gap_m / 2
    boxes[:, 2:] += max_gap_m / 2
    usable = np.flatnonzero(np.isfinite(boxes).all(1))
    if len(usable) < 2:
        return np.zeros((0, 2), np.int64)
    boxes = freeze(boxes[usable], np.float64)
    # A cell about as large as a usual box keeps both the entries a box and the boxes a cell few.
    size = max(float(np.median(boxes[:, 2:] - boxes[:, :2])), 1.0)
    low = np.floor(boxes[:, :2] / size).astype(np.int64)
    span = np.floor(boxes[:, 2:] / size).astype(np.int64) - low + 1
    first = np.concatenate(([0], np.cumsum(span[:, 0] * span[:, 1]))).astype(np.int64)
    row = np.repeat(np.arange(len(boxes)), np.diff(first))
    k = np.arange(first[-1]) - first[row]
    cell = np.stack((low[row, 0] + k // span[row, 1], low[row, 1] + k % span[row, 1]), 1)
    order = np.lexsort((row, cell[:, 1], cell[:, 0]))
    row, cell = row[order], cell[order]
    starts = np.flatnonzero(np.concatenate(([True], (cell[1:] != cell[:-1]).any(1))))
    groups = np.append(starts, len(row))
    pairs = _pairs_in_cells(row, cell, freeze(groups, np.int64), boxes, freeze(low, np.int64))
    pairs = usable[pairs]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def find_near_pairs_between(a_bounds: Floats, b_bounds: Floats, max_gap_m: float) -> Ints:
    """Return (K, 2) rows of a and of b, ascending, whose boxes are at most max_gap_m apart along both axes."""
    pairs = find_near_pairs(np.concatenate((a_bounds, b_bounds)), max_gap_m)
    between_sets = pairs[(pairs[:, 0] < len(a_bounds)) & (pairs[:, 1] >= len(a_bounds))]
    return between_sets - (0, len(a_bounds))


@njit(cache=True)
def _resample(points: F64x2, offsets: I64x1, target: I64x1) -> F64x2:  # pragma: no cover - compiled
    out = np.empty((target[-1], 2))
    for row in range(len(offsets) - 1):
        begin, end = offsets[row], offsets[row + 1]
        count = target[row + 1] - target[row]
        if count == 0:
            continue
        total = 0.0
        for k in range(begin, end - 1):
            total += np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
        k, passed, step = begin, 0.0, 0.0
        if end - begin > 1:
            step = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
        for j in range(count):
            at = total * j / max(count - 1, 1)
            while k < end - 2 and passed + step < at:
                passed += step
                k += 1
                step = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
            fraction = 0.0 if step == 0.0 else min((at - passed) / step, 1.0)
            after = min(k + 1, end - 1)
            for axis in range(2):
                out[target[row] + j, axis] = points[k, axis] + fraction * (points[after, axis] - points[k, axis])
        if count > 1:
            set_row(out[target[row + 1] - 1], points[end - 1])
    return out


@njit(cache=True)
def _project_onto_line(
    queries: F64x2, line: F64x2
) -> tuple[F64x1, F64x1, F64x1, Boolx1]:  # pragma: no cover - compiled
    n = len(queries)
    station, lateral, distance = np.empty(n), np.empty(n), np.empty(n)
    inside = np.empty(n, np.bool_)
    for q in range(n):
        x, y = queries[q]
        best, passed = np.inf, 0.0
        for k in range(len(line) - 1):
            ax, ay = line[k]
            dx, dy = line[k + 1, 0] - ax, line[k + 1, 1] - ay
            squared = dx * dx + dy * dy
            length = np.sqrt(squared)
            fraction = 0.0 if squared == 0.0 else ((x - ax) * dx + (y - ay) * dy) / squared
            held = min(max(fraction, 0.0), 1.0)
            ex, ey = x - ax - held * dx, y - ay - held * dy
            gap = ex * ex + ey * ey
            if gap < best:
                best = gap
                station[q] = passed + held * length
                distance[q] = np.sqrt(gap)
                lateral[q] = distance[q] if dx * (y - ay) - dy * (x - ax) >= 0.0 else -distance[q]
                inside[q] = (fraction > 0.0 or k > 0) and (fraction < 1.0 or k < len(line) - 2)
            passed += length
    return station, lateral, distance, inside


@njit(cache=True)
def _simplify(line: F64x2, tolerance: float) -> Boolx1:  # pragma: no cover - compiled
    n = len(line)
    keep = np.zeros(n, np.bool_)
    if n == 0:
        return keep
    keep[0] = True
    keep[n - 1] = True
    stack = np.empty((n + 1, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, n - 1
    held = 1
    while held > 0:
        held -= 1
        a, b = stack[held]
        dx, dy = line[b, 0] - line[a, 0], line[b, 1] - line[a, 1]
        squared = dx * dx + dy * dy
        worst, place = tolerance * tolerance, -1
        for k in range(a + 1, b):
            ex, ey = line[k, 0] - line[a, 0], line[k, 1] - line[a, 1]
            fraction = 0.0 if squared == 0.0 else min(max((ex * dx + ey * dy) / squared, 0.0), 1.0)
            gap = (ex - fraction * dx) ** 2 + (ey - fraction * dy) ** 2
            if gap > worst:
                worst, place = gap, k
        if place >= 0:
            keep[place] = True
            stack[held, 0], stack[held, 1] = a, place
            stack[held + 1, 0], stack[held + 1, 1] = place, b
            held += 2
    return keep


@njit(cache=True)
def _pairs_in_cells(
    row: I64x1, cell: I64x2, groups: I64x1, boxes: F64x2, low: I64x2
) -> I64x2:  # pragma: no cover - compiled
    out = np.empty((16, 2), np.int64)
    for filling in range(2):
        found = 0
        for g in range(len(groups) - 1):
            for u in range(groups[g], groups[g + 1]):
                i = row[u]
                for v in range(u + 1, groups[g + 1]):
                    j = row[v]
                    if boxes[i, 0] > boxes[j, 2] or boxes[j, 0] > boxes[i, 2]:
                        continue
                    if boxes[i, 1] > boxes[j, 3] or boxes[j, 1] > boxes[i, 3]:
                        continue
                    # Two boxes may share many cells; the pair is found in the least cell that both meet.
                    if max(low[i, 0], low[j, 0]) != cell[u, 0] or max(low[i, 1], low[j, 1]) != cell[u, 1]:
                        continue
                    if filling:
                        out[found, 0], out[found, 1] = i, j
                    found += 1
        if not filling:
            out = np.empty((found, 2), np.int64)
    return out
