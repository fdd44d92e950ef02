# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``claim_offset``."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import F64x1, F64x2, I64x1, I64x2, njit

NEAR_M, MIN_UNMOVED = 3.5, 0.5
"""There is no offset where the agreement without one is one more than MIN_UNMOVED of the claims within NEAR_M of a detection."""


NUM_CELLS = 64
"""Rows and columns of the grid of offsets; a power of two."""


@njit(cache=True, nogil=True)
def list_pairs(claims: F64x2, detections: F64x2, radius_m: float) -> tuple[I64x1, F64x2]:  # pragma: no cover
    """Return the first pair (N + 1) of each claim (N, 2), and the offsets (P, 2) to detections (K, 2) within a radius."""
    first, count = np.zeros(len(claims) + 1, np.int64), 0
    offsets = np.empty((len(claims) * len(detections), 2))
    for i in range(len(claims)):
        for j in range(len(detections)):
            dx, dy = detections[j, 0] - claims[i, 0], detections[j, 1] - claims[i, 1]
            if dx * dx + dy * dy <= radius_m * radius_m:
                offsets[count, 0], offsets[count, 1] = dx, dy
                count += 1
        first[i + 1] = count
    return first, offsets[:count]


@njit(cache=True, nogil=True)
def score_shift(
    first: I64x1, offsets: F64x2, turned: F64x2, shift_x: float, shift_y: float, tolerance_m: float
) -> tuple[float, int, float]:  # pragma: no cover
    """Return the agreement of claims after a shift, the number of claims that agree, and the mean of their displacements.

    turned: (N, 2) what a turn adds to each claim. A claim that is a distance d from a detection then adds 1 - (d / tolerance_m)^2.
    """
    score, number, moved, bound = 0.0, 0, 0.0, tolerance_m * tolerance_m
    for i in range(len(turned)):
        best, row = bound, -1
        for k in range(first[i], first[i + 1]):
            dx, dy = offsets[k, 0] - turned[i, 0] - shift_x, offsets[k, 1] - turned[i, 1] - shift_y
            if dx * dx + dy * dy < best:
                best, row = dx * dx + dy * dy, k
        if row >= 0:
            score, number = score + 1.0 - best / bound, number + 1
            moved += math.hypot(offsets[row, 0], offsets[row, 1])
    return score, number, moved / max(number, 1)


@njit(cache=True, nogil=True)
def _add_to_cells(
    cells: I64x2, first: I64x1, offsets: F64x2, turned: F64x2, cell_m: float, number: int
) -> None:  # pragma: no cover
    """Add a number to the cell of each pair's offset after a turn; the grid repeats itself."""
    for i in range(len(turned)):
        for k in range(first[i], first[i + 1]):
            row = math.floor((offsets[k, 0] - turned[i, 0]) / cell_m) % NUM_CELLS
            column = math.floor((offsets[k, 1] - turned[i, 1]) / cell_m) % NUM_CELLS
            cells[row, column] += number


@njit(cache=True, nogil=True)
def _count_cells(cells: I64x2, x: float, y: float, cell_m: float) -> int:  # pragma: no cover
    """Return the number of pairs in the cell of an offset and in those around it: at least all within cell_m of it."""
    row, column, number = math.floor(x / cell_m), math.floor(y / cell_m), 0
    for a in range(-1, 2):
        for b in range(-1, 2):
            number += cells[(row + a) % NUM_CELLS, (column + b) % NUM_CELLS]
    return number


@njit(cache=True, nogil=True)
def search_offset(
    claims: F64x2, detections: F64x2, pivot: F64x1, turns: F64x1, limits: F64x1
) -> tuple[float, float, int, float]:  # pragma: no cover
    """Try every shift of one claim onto one detection after every turn about the pivot, but those with too few pairs nearby to
    agree better than the best consistent pose.

    limits: search_m, tolerance_m, max_offset_m, ratio, margin of ``OffsetConfig``. Returns the best agreement of displacements up
    to max_offset_m, the best of larger ones where it exceeds that (0 otherwise), and the number of pairs and the displacement of
    the latter.
    """
    search_m, tolerance_m, max_offset_m, ratio, margin = limits
    first, offsets = list_pairs(claims, detections, search_m)
    turned = np.zeros_like(claims)
    far, far_pairs, far_m, num_reachable, num_near = 0.0, 0, 0.0, 0, 0
    for i in range(len(claims)):
        num_reachable += first[i + 1] > first[i]
        for k in range(first[i], first[i + 1]):
            if offsets[k, 0] * offsets[k, 0] + offsets[k, 1] * offsets[k, 1] <= NEAR_M * NEAR_M:
                num_near += 1
                break
    near, _, _ = score_shift(first, offsets, turned, 0.0, 0.0, tolerance_m)
    # No offset can do better than all claims that have a detection within reach; and where most of those near a detection are at
    # their place, there is no offset.
    if near * ratio + margin >= num_reachable or near >= MIN_UNMOVED * num_near + 1.0:
        return near, far, far_pairs, far_m
    cells = np.zeros((NUM_CELLS, NUM_CELLS), np.int64)
    for turn in turns:
        cosine, sine = math.cos(turn) - 1.0, math.sin(turn)
        for i in range(len(claims)):
            dx, dy = claims[i, 0] - pivot[0], claims[i, 1] - pivot[1]
            turned[i, 0], turned[i, 1] = dx * cosine - dy * sine, dx * sine + dy * cosine
        _add_to_cells(cells, first, offsets, turned, tolerance_m, 1)
        for i in range(len(claims)):
            for k in range(first[i], first[i + 1]):
                shift_x, shift_y = offsets[k, 0] - turned[i, 0], offsets[k, 1] - turned[i, 1]
                if _count_cells(cells, shift_x, shift_y, tolerance_m) <= near:
                    continue
                score, pairs, moved = score_shift(first, offsets, turned, shift_x, shift_y, tolerance_m)
                if score <= near:
                    continue
                if moved <= max_offset_m:
                    near = max(near, score)
                elif score > far:
                    far, far_pairs, far_m = score, pairs, moved
        _add_to_cells(cells, first, offsets, turned, tolerance_m, -1)
    return near, far, far_pairs, far_m
