# SPDX-License-Identifier: Apache-2.0
"""Neighbourhoods of map points: elements as points with tangents, a sorted grid, and a limit per cell.

All of it is local and independent of input order. Cells are anchored at the map's origin, points of a cell keep the order of
their observations, and the limit of a crowded cell depends on that cell alone. So a sum over neighbours has the same terms in
the same order for any tiling.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BIAS = 1 << 29  # cells are counted from -2^29 to 2^29 along x and y
_SHIFT = 30


class PointGrid(NamedTuple):
    """Points sorted by (kind, cell): keys (U,) of the occupied cells, offsets (U+1,) and order (P,) of the points.

    The cell with key ``keys[c]`` has points ``order[offsets[c]:offsets[c + 1]]``.
    """

    cell_m: float
    keys: I64x1
    offsets: I64x1
    order: I64x1


def build_grid(x: Floats, y: Floats, kind: Ints, cell_m: float) -> PointGrid:
    """Sort points (P,) into a grid of cells of cell_m; within a cell the points keep their order."""
    key = cell_key(kind, x, y, cell_m)
    order = _argsort_cells(key)
    ordered = key[order]
    begins = np.flatnonzero(np.concatenate((np.ones(min(1, len(key)), bool), ordered[1:] != ordered[:-1])))
    return PointGrid(cell_m, ordered[begins], np.concatenate((begins, [len(key)])).astype(np.int64), order)


def _argsort_cells(key: Ints) -> Ints:
    """Return the stable order (P,) of keys of cells by sorting one number of cell and point, unless these exceed an integer."""
    part = (1 << _SHIFT) - 1
    number = np.zeros(len(key), np.int64)
    for shift in (2 * _SHIFT, _SHIFT, 0):
        column = (key >> shift) & part
        low = column.min(initial=part)
        number = number * (column.max(initial=low) - low + 1) + column - low
    if number.max(initial=0) >= np.iinfo(np.int64).max // max(len(key), 1) - 1:
        return np.argsort(key, kind="stable")
    return np.sort(number * len(key) + np.arange(len(key))) % max(len(key), 1)


def cell_key(kind: Ints, x: Floats, y: Floats, cell_m: float) -> Ints:
    """Compute one integer (P,) for kind and cell; neighbouring cells along y have neighbouring keys."""
    ix = np.floor(x / cell_m).astype(np.int64) + _BIAS
    iy = np.floor(y / cell_m).astype(np.int64) + _BIAS
    return (kind.astype(np.int64) << (2 * _SHIFT)) | (ix << _SHIFT) | iy


@njit(cache=True, nogil=True)
def find_cell_range(
    keys: I64x1, start: I64x1, kind: int, ix: int, iy0: int, iy1: int
) -> tuple[int, int]:  # pragma: no cover - compiled
    """Find the range in a grid's order of the points of cells (ix, iy0..iy1) of a kind."""
    base = (kind << 60) | ((ix + 536870912) << 30)
    low = lower_bound(keys, base | (iy0 + 536870912))
    high, end = low, base | (iy1 + 536870912)
    while high < len(keys) and keys[high] <= end:
        high += 1
    return start[low], start[high]


@njit(cache=True, nogil=True)
def lower_bound(keys: I64x1, key: int) -> int:  # pragma: no cover - compiled
    """Return the first index in ascending keys whose key is not smaller than this one."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def line_residual(
    dx: float,
    dy: float,
    u: float,
    v: float,
    other_u: float,
    other_v: float,
    min_cosine: float,
    by_reciprocal: bool = False,
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Compute the longitudinal and the lateral offset (dx, dy) of another line's point, along the mean direction of both lines.

    The lines have unit tangents (u, v) and (other_u, other_v) without a sense. Both results are infinite where the cosine of the
    tangents is below ``min_cosine``. by_reciprocal: multiply by the reciprocal of the norm, which rounds otherwise than a division.
    """
    dot = u * other_u + v * other_v
    if abs(dot) < min_cosine:
        return np.inf, np.inf
    sign = 1.0 if dot > 0.0 else -1.0
    norm = np.sqrt(2.0 + 2.0 * abs(dot))
    if by_reciprocal:
        scale = 1.0 / norm
        mx, my = (u + sign * other_u) * scale, (v + sign * other_v) * scale
    else:
        mx, my = (u + sign * other_u) / norm, (v + sign * other_v) / norm
    return dx * mx + dy * my, dy * mx - dx * my


@njit(cache=True, nogil=True)
def resample_lines(
    offsets: I64x1, points: F64x2, sigma: F64x1, closed: Boolx1, spacing_m: float
) -> tuple[I64x1, F64x2, F64x2, F64x1]:  # pragma: no cover - compiled
    """Resample elements (E) at equal arc length, about ``spacing_m`` apart, with unit tangents and sigma.

    Returns offsets (E+1,), points (P, 2), tangents (P, 2) and sigma (P,). A closed ring does not repeat its first point; an
    element without length gives no points. The tangent is the chord over the two neighbours, which halves the noise of a
    vertex.
    """
    count = len(offsets) - 1
    sizes = np.zeros(count + 1, np.int64)
    lengths = np.zeros(count, np.float64)
    for e in range(count):
        length = 0.0
        n = offsets[e + 1] - offsets[e]
        last = n if closed[e] else n - 1
        for k in range(last):
            i, j = offsets[e] + k, offsets[e] + (k + 1) % n
            length += np.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
        lengths[e] = length
        if n >= 2 and length > 1e-6:
            steps = max(1 if not closed[e] else 3, int(np.floor(length / spacing_m + 0.5)))
            sizes[e + 1] = steps if closed[e] else steps + 1
    out_first = np.cumsum(sizes)
    total = out_first[-1]
    xy, tangent, wide = np.empty((total, 2)), np.empty((total, 2)), np.empty(total)
    for e in range(count):
        a, b = out_first[e], out_first[e + 1]
        if a == b:
            continue
        n = offsets[e + 1] - offsets[e]
        step = lengths[e] / ((b - a) if closed[e] else (b - a - 1))
        k, walked = 0, 0.0
        i, j = offsets[e], offsets[e] + 1 % n
        piece = np.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
        last = n if closed[e] else n - 1
        for r in range(b - a):
            target = r * step
            while walked + piece < target and k < last - 1:
                walked += piece
                k += 1
                i, j = offsets[e] + k, offsets[e] + (k + 1) % n
                piece = np.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
            f = min(1.0, (target - walked) / piece) if piece > 0.0 else 0.0
            xy[a + r, 0] = points[i, 0] + f * (points[j, 0] - points[i, 0])
            xy[a + r, 1] = points[i, 1] + f * (points[j, 1] - points[i, 1])
            wide[a + r] = sigma[i] + f * (sigma[j] - sigma[i])
        for r in range(a, b):
            i = r - 1 if r > a else (b - 1 if closed[e] else a)
            j = r + 1 if r < b - 1 else (a if closed[e] else b - 1)
            dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            norm = np.hypot(dx, dy)
            if norm > 0.0:
                tangent[r, 0], tangent[r, 1] = dx / norm, dy / norm
            else:
                tangent[r, 0], tangent[r, 1] = 1.0, 0.0
    return out_first, xy, tangent, wide


def limit_observations(
    key: Ints, observation: Ints, agent: Ints, rank: Ints, max_observations: int
) -> NDArray[np.bool_]:
    """Select the points (P,) that remain when a cell may contain at most ``max_observations`` observations.

    key: (P,) of the cell (kind, place and heading). observation: (P,). agent, rank: (O,) agent and rank of each observation;
    lower is better: more information, then newer, then smaller id. Agents alternate, each with its best observation first, so
    that one agent cannot displace the others.
    """
    # Points come along lines, so the loop runs over runs of one cell and one observation, not over points.
    begins = np.ones(len(key), bool)
    begins[1:] = (key[1:] != key[:-1]) | (observation[1:] != observation[:-1])
    run = np.cumsum(begins) - 1
    cell, observer = key[begins], observation[begins].astype(np.int64)
    order = np.lexsort((observer, cell))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (cell[order][1:] != cell[order][:-1]) | (observer[order][1:] != observer[order][:-1])
    pair = np.empty(len(order), np.int64)
    pair[order] = np.cumsum(fresh) - 1
    cell, observer = cell[order][fresh], observer[order][fresh]
    turn = _rank_in_group((cell, agent[observer]), rank[observer])
    place = _rank_in_group((cell,), turn * (rank.max(initial=0) + 1) + rank[observer])
    return (place < max_observations)[pair[run]]


def _rank_in_group(group: tuple[Ints, ...], value: Ints) -> Ints:
    """Count, for each row, the rows of its group with a smaller value."""
    order = np.lexsort((value, *reversed(group)))
    new = np.zeros(len(value), bool)
    new[:1] = True
    for column in group:
        ordered = column[order]
        new[1:] |= ordered[1:] != ordered[:-1]
    index = np.arange(len(value))
    place = np.empty(len(value), np.int64)
    place[order] = index - np.maximum.accumulate(np.where(new, index, 0))
    return place


def hash_coordinates(xy: Floats) -> NDArray[np.uint64]:
    """Hash the coordinates of points in their agent's frame (splitmix64 of their bits) to an integer (P,).

    It gives an order that no motion of the world, no tile and no other observation changes.
    """
    bits = np.ascontiguousarray(xy + 0.0, np.float64).view(np.uint64).reshape(-1, 2)
    with np.errstate(over="ignore"):
        return _mix(_mix(bits[:, 0]) + bits[:, 1])


def _mix(word: NDArray[np.uint64]) -> NDArray[np.uint64]:
    word = word + np.uint64(0x9E3779B97F4A7C15)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))
