# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``association``."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import F64x1, F64x2, I64x1, njit


@njit(cache=True, nogil=True)
def find_partners(one: F64x2, other: F64x2, gate_m: F64x1) -> I64x1:  # pragma: no cover
    """Return the partner of each of (N, 2) among (M, 2), -1 without one; nearest pairs first, equal ones in their order."""
    n, m = len(one), len(other)
    partner, count = np.full(n, -1, np.int64), 0
    for i in range(n):
        for j in range(m):
            dx, dy = one[i, 0] - other[j, 0], one[i, 1] - other[j, 1]
            count += dx * dx + dy * dy < gate_m[i] * gate_m[i]
    if count == 0:
        return partner
    squared, rows, columns, at = np.empty(count), np.empty(count, np.int64), np.empty(count, np.int64), 0
    for i in range(n):
        for j in range(m):
            dx, dy = one[i, 0] - other[j, 0], one[i, 1] - other[j, 1]
            if dx * dx + dy * dy < gate_m[i] * gate_m[i]:
                squared[at], rows[at], columns[at] = dx * dx + dy * dy, i, j
                at += 1
    is_taken = np.zeros(m, np.bool_)
    for k in np.argsort(squared, kind="mergesort"):
        if partner[rows[k]] < 0 and not is_taken[columns[k]]:
            partner[rows[k]] = columns[k]
            is_taken[columns[k]] = True
    return partner


@njit(cache=True, nogil=True)
def nearest_rows(one: F64x2, other: F64x2, radius_m: float) -> I64x1:  # pragma: no cover
    """Return the row of the nearest of (M, 2) for each of (N, 2), -1 where none is within the radius."""
    found = np.full(len(one), -1, np.int64)
    for i in range(len(one)):
        best = radius_m * radius_m
        for j in range(len(other)):
            dx, dy = one[i, 0] - other[j, 0], one[i, 1] - other[j, 1]
            if dx * dx + dy * dy <= best and (found[i] < 0 or dx * dx + dy * dy < best):
                best, found[i] = dx * dx + dy * dy, j
    return found
