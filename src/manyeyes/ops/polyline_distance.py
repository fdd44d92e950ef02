# SPDX-License-Identifier: Apache-2.0
"""Distances between many pairs of polylines at once: Chamfer, directed point-to-segment, discrete Frechet.

Lines are columns as in :mod:`manyeyes.ops.polyline`; pairs: (K, 2), rows of a and of b. For a published Chamfer distance,
resample first: 100 points a line (MapTR, VectorMapNet), 200 (StreamMapNet, MapTracker, GlobalMapNet), or a fixed spacing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, I64x2, njit
from manyeyes.datatypes.map_element import freeze

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def chamfer_distance(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints) -> Floats:
    """Return (K,) half the sum of both mean distances from a point to the nearest point of the other line."""
    return _chamfer(*_columns(a, a_offsets, b, b_offsets), freeze(pairs, np.int64))


def directed_distance(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints) -> tuple[Floats, Floats]:
    """Return (K,) the mean and (K,) the greatest distance from the points of a's line to the segments of b's."""
    return _compute_directed(*_columns(a, a_offsets, b, b_offsets), freeze(pairs, np.int64))[:2]


def min_distance(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints) -> Floats:
    """Return (K,) the least distance from a point of a's line to a segment of b's."""
    return _compute_directed(*_columns(a, a_offsets, b, b_offsets), freeze(pairs, np.int64))[2]


def frechet_distance(
    a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints, pairs: Ints, either_way: bool = True
) -> Floats:
    """Return (K,) discrete Frechet distance (Eiter and Mannila 1994) between vertices; the lesser of b's two directions if
    asked.
    """
    return _frechet(*_columns(a, a_offsets, b, b_offsets), freeze(pairs, np.int64), either_way)


def _columns(a: Floats, a_offsets: Ints, b: Floats, b_offsets: Ints) -> tuple[Floats, Ints, Floats, Ints]:
    """Return all arrays read-only and contiguous, so that one compiled form serves every caller."""
    return freeze(a, np.float64), freeze(a_offsets, np.int64), freeze(b, np.float64), freeze(b_offsets, np.int64)


@njit(cache=True)
def _nearest_points(a: F64x2, a0: int, a1: int, b: F64x2, b0: int, b1: int) -> float:  # pragma: no cover - compiled
    total = 0.0
    for i in range(a0, a1):
        best = np.inf
        x, y = a[i, 0], a[i, 1]
        for j in range(b0, b1):
            gap = (x - b[j, 0]) ** 2 + (y - b[j, 1]) ** 2
            best = min(best, gap)
        total += np.sqrt(best)
    return total / max(a1 - a0, 1)


@njit(cache=True)
def _chamfer(
    a: F64x2, a_offsets: I64x1, b: F64x2, b_offsets: I64x1, pairs: I64x2
) -> F64x1:  # pragma: no cover - compiled
    out = np.empty(len(pairs))
    for k in range(len(pairs)):
        i, j = int(pairs[k, 0]), int(pairs[k, 1])
        a0, a1, b0, b1 = a_offsets[i], a_offsets[i + 1], b_offsets[j], b_offsets[j + 1]
        out[k] = 0.5 * (_nearest_points(a, a0, a1, b, b0, b1) + _nearest_points(b, b0, b1, a, a0, a1))
    return out


@njit(cache=True)
def _compute_directed(
    a: F64x2, a_offsets: I64x1, b: F64x2, b_offsets: I64x1, pairs: I64x2
) -> tuple[F64x1, F64x1, F64x1]:  # pragma: no cover - compiled
    mean, max_distance, smallest = np.empty(len(pairs)), np.zeros(len(pairs)), np.full(len(pairs), np.inf)
    for k in range(len(pairs)):
        i, j = int(pairs[k, 0]), int(pairs[k, 1])
        total = 0.0
        for p in range(a_offsets[i], a_offsets[i + 1]):
            x, y = a[p, 0], a[p, 1]
            best = np.inf
            for q in range(b_offsets[j], max(b_offsets[j + 1] - 1, b_offsets[j] + 1)):
                r = min(q + 1, b_offsets[j + 1] - 1)
                dx, dy = b[r, 0] - b[q, 0], b[r, 1] - b[q, 1]
                ex, ey = x - b[q, 0], y - b[q, 1]
                squared = dx * dx + dy * dy
                fraction = 0.0 if squared == 0.0 else min(max((ex * dx + ey * dy) / squared, 0.0), 1.0)
                best = min(best, (ex - fraction * dx) ** 2 + (ey - fraction * dy) ** 2)
            total += np.sqrt(best)
            max_distance[k] = max(max_distance[k], np.sqrt(best))
            smallest[k] = min(smallest[k], np.sqrt(best))
        mean[k] = total / max(a_offsets[i + 1] - a_offsets[i], 1)
    return mean, max_distance, smallest


@njit(cache=True)
def _frechet_one(
    a: F64x2, a0: int, a1: int, b: F64x2, b0: int, b1: int, backwards: bool
) -> float:  # pragma: no cover - compiled
    n, m = a1 - a0, b1 - b0
    row = np.empty(m)
    for i in range(n):
        corner = 0.0
        for j in range(m):
            q = b1 - 1 - j if backwards else b0 + j
            gap = (a[a0 + i, 0] - b[q, 0]) ** 2 + (a[a0 + i, 1] - b[q, 1]) ** 2
            if i == 0 and j == 0:
                reached = gap
            elif i == 0:
                reached = max(row[j - 1], gap)
            elif j == 0:
                reached = max(row[0], gap)
            else:
                reached = max(min(corner, row[j], row[j - 1]), gap)
            # row[j] still holds the row before: it is the corner of the next column.
            corner = row[j]
            row[j] = reached
    return np.sqrt(row[m - 1])


@njit(cache=True)
def _frechet(
    a: F64x2, a_offsets: I64x1, b: F64x2, b_offsets: I64x1, pairs: I64x2, either_way: bool
) -> F64x1:  # pragma: no cover - compiled
    out = np.empty(len(pairs))
    for k in range(len(pairs)):
        i, j = int(pairs[k, 0]), int(pairs[k, 1])
        a0, a1, b0, b1 = a_offsets[i], a_offsets[i + 1], b_offsets[j], b_offsets[j + 1]
        out[k] = _frechet_one(a, a0, a1, b, b0, b1, False)
        if either_way:
            out[k] = min(out[k], _frechet_one(a, a0, a1, b, b0, b1, True))
    return out
