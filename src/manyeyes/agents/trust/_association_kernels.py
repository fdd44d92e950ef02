# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``association``."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit


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


@njit(cache=True, nogil=True)
def match_claims(
    xy: F64x2, gate_m: F64x1, first: I64x1, own: F64x2, is_trusted: Boolx1, copy_m: float, max_copied: float
) -> tuple[Boolx1, Boolx1]:  # pragma: no cover
    """Return (N,) which claims match one of the ego's detections (K, 2), and which match a claim of a trusted third agent.

    xy (N, 2), gate_m (N,): claims of all senders, one after the other; first: (S + 1,) of each sender. A third agent that states
    more than max_copied of the claims within copy_m is no other source.
    """
    is_own, is_corroborated = np.zeros(len(xy), np.bool_), np.zeros(len(xy), np.bool_)
    for n in range(len(first) - 1):
        begin, end = first[n], first[n + 1]
        if begin == end:
            continue
        partner = find_partners(xy[begin:end], own, gate_m[begin:end])
        for row in range(len(partner)):
            is_own[begin + row] = partner[row] >= 0
        for k in range(len(first) - 1):
            third = xy[first[k] : first[k + 1]]
            if k == n or not is_trusted[k] or not len(third):
                continue
            fewest = min(end - begin, len(third))
            equal = find_partners(xy[begin:end], third, np.full(end - begin, copy_m)) >= 0
            if fewest >= 2 and equal.sum() > max_copied * fewest:
                continue
            is_corroborated[begin:end] |= find_partners(xy[begin:end], third, gate_m[begin:end]) >= 0
    return is_own, is_corroborated
