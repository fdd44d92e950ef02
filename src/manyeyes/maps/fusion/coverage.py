# SPDX-License-Identifier: Apache-2.0
"""Observed ground as runs of cells of one metre, and cutting of lines outside of it.

A link may join two parts of a line across ground that lies in no view. A map should not contain such parts. Cells are anchored
at the map's origin and count as observed where a view contains their centre. So the observed ground of several areas is the
union of each area's. GlobalMapNet's protocol (arXiv 2409.10063) also evaluates maps on the union of all views.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x2, I64x1, I64x2, njit, set_row
from manyeyes.maps.fusion.observation_arrays import ObservationArrays
from manyeyes.ops._sort_kernels import sort

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CELL_M = 1.0


def find_observed_cells(
    arrays: ObservationArrays, pose: Floats, area: tuple[float, float, float, float] | None = None
) -> Ints:
    """Find the ground in the views of agents at pose (O, 3), inside area (x0, y0, x1, y1; whole metres) or everywhere.

    Returns runs (R, 3): row, first column and last column of cells, ascending; no two runs touch.
    """
    runs = fill_rings(arrays.view_corners_in_world(pose), arrays.view.ring_offsets)
    return merge_runs(runs if area is None else clip_runs(runs, area))


def clip_runs(runs: Ints, area: tuple[float, float, float, float]) -> Ints:
    """Return the parts of runs (R, 3) inside an area (x0, y0, x1, y1; whole metres)."""
    x0, y0, x1, y1 = np.floor(np.array(area) / CELL_M + 0.5).astype(np.int64)
    runs = runs[(runs[:, 0] >= y0) & (runs[:, 0] < y1) & (runs[:, 1] < x1) & (runs[:, 2] >= x0)]
    return np.stack((runs[:, 0], np.maximum(runs[:, 1], x0), np.minimum(runs[:, 2], x1 - 1)), 1)


def find_cells_under_lines(points: Floats, offsets: Ints) -> Ints:
    """Find the ground under N lines: points (P, 2) metres, offsets (N + 1,); runs as in :func:`find_observed_cells`."""
    if not len(points):
        return np.zeros((0, 3), np.int64)
    return merge_runs(_trace_lines(np.ascontiguousarray(points), offsets))


def merge_runs(runs: Ints) -> Ints:
    """Sort runs (R, 3) and merge those that touch or overlap."""
    if not len(runs):
        return np.zeros((0, 3), np.int64)
    return _merge_runs(runs[np.lexsort((runs[:, 1], runs[:, 0]))])


def cut_unobserved(points: Floats, offsets: Ints, inferred: NDArray[np.bool_], runs: Ints) -> tuple[Ints, Ints]:
    """Cut L lines at unobserved ground: offsets (M + 1,) of the parts, and the rows of the points that remain, in order.

    points: (P, 2) metres. inferred: (P,) points without an observation of their own, which are dropped on unobserved ground. A
    line is cut between two points if a cell between them, sampled every half metre, is in no run (R, 3). Without runs the
    observed ground is unknown and nothing is cut.
    """
    if not len(runs) or not len(points):
        return offsets, np.arange(len(points))
    return _cut(np.ascontiguousarray(points), offsets, inferred, runs)


@njit(cache=True, nogil=True)
def fill_rings(corners: F64x2, first: I64x1) -> I64x2:  # pragma: no cover - compiled
    """Runs of cells whose middle lies in a ring, by the even-odd rule, ring by ring."""
    rows, n = np.empty((1024, 3), np.int64), 0
    for r in range(len(first) - 1):
        a, b = first[r], first[r + 1]
        if b - a < 3:
            continue
        low = int(np.ceil(corners[a:b, 1].min() / CELL_M - 0.5))
        high = int(np.floor(corners[a:b, 1].max() / CELL_M - 0.5))
        meets = np.empty(b - a)
        for iy in range(low, high + 1):
            y, count = (iy + 0.5) * CELL_M, 0
            j = b - 1
            for i in range(a, b):
                y0, y1 = corners[j, 1], corners[i, 1]
                if (y0 > y) != (y1 > y):
                    meets[count] = corners[j, 0] + (corners[i, 0] - corners[j, 0]) * (y - y0) / (y1 - y0)
                    count += 1
                j = i
            across = sort(meets[:count])
            for k in range(0, count - 1, 2):
                begin = int(np.ceil(across[k] / CELL_M - 0.5))
                end = int(np.floor(across[k + 1] / CELL_M - 0.5))
                if end < begin:
                    continue
                if n == len(rows):
                    longer = np.empty((2 * n, 3), np.int64)
                    for r in range(n):
                        set_row(longer[r], rows[r])
                    rows = longer
                rows[n, 0], rows[n, 1], rows[n, 2] = iy, begin, end
                n += 1
    return rows[:n].copy()


@njit(cache=True, nogil=True)
def _trace_lines(points: F64x2, first: I64x1) -> I64x2:  # pragma: no cover - compiled
    """Return the cells under lines as runs (R, 3) of one cell each, sampled every half cell."""
    total = len(points)
    for c in range(len(first) - 1):
        for i in range(first[c], first[c + 1] - 1):
            total += _count_steps(points, i)
    rows, n = np.empty((total, 3), np.int64), 0
    for c in range(len(first) - 1):
        for i in range(first[c], first[c + 1]):
            steps = _count_steps(points, i) if i + 1 < first[c + 1] else 1
            after = i + 1 if i + 1 < first[c + 1] else i
            for k in range(steps):
                x = points[i, 0] + (points[after, 0] - points[i, 0]) * k / steps
                y = points[i, 1] + (points[after, 1] - points[i, 1]) * k / steps
                rows[n, 0] = int(np.floor(y / CELL_M))
                rows[n, 1] = rows[n, 2] = int(np.floor(x / CELL_M))
                n += 1
    return rows[:n]


@njit(cache=True, nogil=True)
def _count_steps(points: F64x2, i: int) -> int:  # pragma: no cover - compiled
    """Count the steps of half a cell from a point to the next."""
    return max(
        1, int(np.ceil(2.0 * np.hypot(points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]) / CELL_M))
    )


@njit(cache=True, nogil=True)
def _merge_runs(runs: I64x2) -> I64x2:  # pragma: no cover - compiled
    """Merge sorted runs that touch or overlap."""
    out, n = runs.copy(), 0
    for k in range(1, len(runs)):
        if runs[k, 0] == out[n, 0] and runs[k, 1] <= out[n, 2] + 1:
            out[n, 2] = max(out[n, 2], runs[k, 2])
        else:
            n += 1
            set_row(out[n], runs[k])
    return out[: n + 1].copy()


@njit(cache=True, nogil=True)
def _cut(
    points: F64x2, first: I64x1, inferred: Boolx1, runs: I64x2
) -> tuple[I64x1, I64x1]:  # pragma: no cover - compiled
    """Cut lines as :func:`cut_unobserved` describes."""
    offsets, kept, n = [0], np.empty(len(points), np.int64), 0
    for c in range(len(first) - 1):
        for i in range(first[c], first[c + 1]):
            if inferred[i] and not _is_observed(runs, points[i, 0], points[i, 1]):
                if n > offsets[-1]:
                    offsets.append(n)
                continue
            if n > offsets[-1] and not _is_observed_between(points, kept[n - 1], i, runs):
                offsets.append(n)
            kept[n] = i
            n += 1
        if n > offsets[-1]:
            offsets.append(n)
    return np.array(offsets), kept[:n].copy()


@njit(cache=True, nogil=True)
def _is_observed_between(points: F64x2, i: int, j: int, runs: I64x2) -> bool:  # pragma: no cover - compiled
    """Return whether all ground between two points is observed; True for points less than 1.5 cells apart."""
    dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
    length = np.hypot(dx, dy)
    if length < 1.5 * CELL_M:
        return True
    steps = int(np.ceil(2.0 * length / CELL_M))
    k = 1
    while k < steps and _is_observed(runs, points[i, 0] + dx * k / steps, points[i, 1] + dy * k / steps):
        k += 1
    return k == steps


@njit(cache=True, nogil=True)
def _is_observed(runs: I64x2, x: float, y: float) -> bool:  # pragma: no cover - compiled
    """Return whether the cell of a place is in a run."""
    ix, iy = int(np.floor(x / CELL_M)), int(np.floor(y / CELL_M))
    low, high = 0, len(runs)
    while low < high:
        middle = (low + high) >> 1
        if runs[middle, 0] < iy or (runs[middle, 0] == iy and runs[middle, 1] <= ix):
            low = middle + 1
        else:
            high = middle
    return low > 0 and runs[low - 1, 0] == iy and runs[low - 1, 2] >= ix
