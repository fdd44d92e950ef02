# SPDX-License-Identifier: Apache-2.0
"""The nearest of many polylines to each of many points, exact within a distance, by a grid over segments.

Lines are columns: points (P, 2) metres and first (N+1,) offsets, line i being ``points[first[i]:first[i + 1]]``. A ring is
given closed, its first point repeated. The slow twin compares every point with every segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class NearestLines:
    """For each query: distance (Q,) metres, inf beyond reach; line (Q,) its row, -1 beyond; heading (Q,) of its segment.

    lateral_m: (Q,) metres from the straight line through that segment, left positive: beside a line's end, less than distance.
    """

    distance: Floats
    line: Ints
    heading: Floats
    lateral_m: Floats


def find_nearest_line(queries: Floats, points: Floats, offsets: Ints, max_distance_m: float) -> NearestLines:
    """Return the nearest line within reach of each query (Q, 2); of equally near ones the lowest row."""
    queries = np.ascontiguousarray(queries, dtype=np.float64).reshape(-1, 2)
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    offsets = np.ascontiguousarray(offsets, dtype=np.int64)
    line, start = segments_of(offsets)
    if len(queries) == 0 or len(start) == 0:
        nothing = np.full(len(queries), np.inf)
        return NearestLines(nothing, np.full(len(queries), -1, dtype=np.int64), np.zeros(len(queries)), nothing)
    origin = points.min(0) - max_distance_m
    # A cell of the reach keeps the lists short; a segment is entered in every cell that its box, grown by the reach, meets.
    size = max(max_distance_m, 1.0)
    shape = np.floor((points.max(0) + max_distance_m - origin) / size).astype(np.int64) + 1
    grid = _enter(points, start, np.array([origin[0], origin[1], size]), shape, max_distance_m)
    return NearestLines(*_find_nearest(queries, points, start, line, grid, max_distance_m))


def find_nearest_line_slow(queries: Floats, points: Floats, offsets: Ints, max_distance_m: float) -> NearestLines:
    """Return the slow twin of :func:`find_nearest_line`."""
    distance, owner, heading, lateral = [], [], [], []
    line, start = segments_of(offsets)
    for query in np.asarray(queries, dtype=np.float64).reshape(-1, 2):
        best = (np.inf, -1, 0.0, np.inf)
        for row, s in zip(line, start):
            a, d = points[s], points[s + 1] - points[s]
            t = min(1.0, max(0.0, float((query - a) @ d) / float(d @ d))) if d @ d > 0 else 0.0
            away = float(np.hypot(*(query - a - t * d)))
            if away <= max_distance_m and away < best[0]:
                beside = (
                    float(d[0] * (query - a)[1] - d[1] * (query - a)[0]) / float(np.hypot(*d)) if d @ d > 0 else away
                )
                best = (away, int(row), float(np.arctan2(d[1], d[0])), beside)
        distance.append(best[0])
        owner.append(best[1])
        heading.append(best[2])
        lateral.append(best[3])
    return NearestLines(np.array(distance), np.array(owner, dtype=np.int64), np.array(heading), np.array(lateral))


def segments_of(offsets: Ints) -> tuple[Ints, Ints]:
    """line (S,) and start (S,): which line each segment belongs to, and the row of points that it starts at."""
    offsets = np.asarray(offsets, dtype=np.int64)
    count = np.maximum(np.diff(offsets) - 1, 0)
    line = np.repeat(np.arange(len(count), dtype=np.int64), count)
    within = np.arange(len(line), dtype=np.int64) - np.repeat(np.cumsum(count) - count, count)
    return line, offsets[line] + within


class _SegmentGrid(NamedTuple):
    """Cells over segments: place: origin x, y and cell size (m); shape: columns, rows. Cell c has the segments
    ``held[offset[c]:offset[c + 1]]``, ascending.
    """

    place: F64x1
    shape: I64x1
    offset: I64x1
    held: I64x1


@njit(cache=True)
def _enter(points: F64x2, start: I64x1, place: F64x1, shape: I64x1, reach: float) -> _SegmentGrid:
    """Enter each segment, which begins at a row of start, in the cells that its box, grown by the reach, meets."""
    size, columns, rows = place[2], shape[0], shape[1]
    count = np.zeros(columns * rows + 1, dtype=np.int64)
    offset, held, fill = count, count, count
    for turn in range(2):
        if turn == 1:
            offset = np.cumsum(count)
            held = np.empty(offset[-1], dtype=np.int64)
            fill = offset[:-1].copy()
        for k in range(len(start)):
            s = start[k]
            x0 = int((min(points[s, 0], points[s + 1, 0]) - reach - place[0]) / size)
            x1 = int((max(points[s, 0], points[s + 1, 0]) + reach - place[0]) / size)
            y0 = int((min(points[s, 1], points[s + 1, 1]) - reach - place[1]) / size)
            y1 = int((max(points[s, 1], points[s + 1, 1]) + reach - place[1]) / size)
            for x in range(max(x0, 0), min(x1, columns - 1) + 1):
                for y in range(max(y0, 0), min(y1, rows - 1) + 1):
                    cell = x * rows + y
                    if turn == 0:
                        count[cell + 1] += 1
                    else:
                        held[fill[cell]] = k
                        fill[cell] += 1
    return _SegmentGrid(place, shape, offset, held)


@njit(cache=True)
def _find_nearest(
    queries: F64x2, points: F64x2, start: I64x1, line: I64x1, grid: _SegmentGrid, reach: float
) -> tuple[F64x1, I64x1, F64x1, F64x1]:
    """Return the distance, line, heading and offset across of each query's nearest segment in its own cell."""
    place, shape, offset, held = grid
    size, columns, rows = place[2], shape[0], shape[1]
    distance = np.full(len(queries), np.inf)
    owner = np.full(len(queries), -1, dtype=np.int64)
    heading = np.zeros(len(queries))
    lateral = np.full(len(queries), np.inf)
    for q in range(len(queries)):
        x, y = queries[q, 0], queries[q, 1]
        column, row = np.floor((x - place[0]) / size), np.floor((y - place[1]) / size)
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        cell = int(column) * rows + int(row)
        best = np.inf
        for h in range(offset[cell], offset[cell + 1]):
            s = start[held[h]]
            dx, dy = points[s + 1, 0] - points[s, 0], points[s + 1, 1] - points[s, 1]
            square = dx * dx + dy * dy
            t = ((x - points[s, 0]) * dx + (y - points[s, 1]) * dy) / square if square > 0 else 0.0
            t = min(1.0, max(0.0, t))
            away = np.hypot(x - points[s, 0] - t * dx, y - points[s, 1] - t * dy)
            if away < best and away <= reach:
                best = away
                distance[q], owner[q], heading[q] = away, line[held[h]], np.arctan2(dy, dx)
                beside = dx * (y - points[s, 1]) - dy * (x - points[s, 0])
                lateral[q] = beside / np.sqrt(square) if square > 0 else away
    return distance, owner, heading, lateral
