# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``association``."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import Boolx1, Boolx2, F64x1, F64x2, I64x1, U8x1, njit
from manyeyes.ops._sort_kernels import argsort


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
    for k in argsort(squared):
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
def find_places(senders: F64x2, min_apart_m: float) -> I64x1:  # pragma: no cover
    """Return (S,) the number of the place of each sender (S, 2): of a chain of senders nearer than min_apart_m it is one."""
    place = np.arange(len(senders))
    for i in range(len(senders)):
        for j in range(i):
            if math.hypot(senders[i, 0] - senders[j, 0], senders[i, 1] - senders[j, 1]) < min_apart_m:
                merged, kept = place[i], place[j]
                for k in range(i + 1):
                    if place[k] == merged:
                        place[k] = kept
    return place


@njit(cache=True, nogil=True)
def match_claims(
    xy: F64x2,
    gate_m: F64x1,
    is_likely: Boolx1,
    first: I64x1,
    own: F64x2,
    is_trusted: Boolx1,
    senders: F64x2,
    limits: tuple[float, float, float],
) -> tuple[Boolx1, Boolx1]:  # pragma: no cover
    """Return (N,) which claims match one of the ego's detections (K, 2), and which match a likely claim of a trusted third agent.

    xy (N, 2), gate_m (N,), is_likely (N,): claims of all senders, one after the other; first: (S + 1,) of each sender, which are at
    senders (S, 2). limits: copy_m, max_copied, min_apart_m. A third agent that states more than max_copied of the claims within
    copy_m, or is at the same place, is no other source.
    """
    copy_m, max_copied, min_apart_m = limits
    place = find_places(senders, min_apart_m)
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
            if k == n or place[k] == place[n] or not is_trusted[k] or not len(third):
                continue
            fewest = min(end - begin, len(third))
            equal = find_partners(xy[begin:end], third, np.full(end - begin, copy_m)) >= 0
            if fewest >= 2 and equal.sum() > max_copied * fewest:
                continue
            likely = third[is_likely[first[k] : first[k + 1]]]
            is_corroborated[begin:end] |= find_partners(xy[begin:end], likely, gate_m[begin:end]) >= 0
    return is_own, is_corroborated


@njit(cache=True, nogil=True)
def count_equal(
    xy: F64x2, places: F64x2, sizes: I64x1, agents: I64x1, agent_id: int, equal_m: float
) -> I64x1:  # pragma: no cover
    """Return (C,) how many of the positions (N, 2) of an agent are nearest to one of each content of other agents, within equal_m.

    places (M, 2): of all contents, one after the other, of sizes (C,) and agents (C,).
    """
    equal = np.zeros(len(sizes), np.int64)
    for i in range(len(xy)):
        best, row, begin = equal_m * equal_m, -1, 0
        for content in range(len(sizes)):
            end = begin + sizes[content]
            if agents[content] != agent_id:
                for j in range(begin, end):
                    dx = xy[i, 0] - places[j, 0]
                    if abs(dx) > equal_m:
                        continue
                    dy = xy[i, 1] - places[j, 1]
                    squared = dx * dx + dy * dy
                    if squared <= best and (row < 0 or squared < best):
                        best, row = squared, content
            begin = end
        if row >= 0:
            equal[row] += 1
    return equal


@njit(cache=True, nogil=True)
def find_supporting_claims(
    xy: F64x2, places: F64x2, kinds: U8x1, first: I64x1, trust: F64x1, refuted: int, radius_m: float
) -> tuple[U8x1, F64x1, Boolx2]:  # pragma: no cover
    """Return for positions (N, 2) the highest evidence (N,) of the nearest claims of all senders within a radius, the highest trust
    (N,) in these senders, 0 without any, and which senders claim it (S, N).

    places (M, 2), kinds (M,): of the claims of all senders, one after the other; first: (S + 1,) of each sender. trust: (S,).
    refuted: the kind of claims that support nothing.
    """
    found, highest = np.zeros(len(xy), np.uint8), np.zeros(len(xy))
    is_near = np.zeros((len(trust), len(xy)), np.bool_)
    for s in range(len(trust)):
        for i in range(len(xy)):
            best, row = radius_m * radius_m, -1
            for j in range(first[s], first[s + 1]):
                dx, dy = xy[i, 0] - places[j, 0], xy[i, 1] - places[j, 1]
                squared = dx * dx + dy * dy
                if squared <= best and kinds[j] != refuted and (row < 0 or squared < best):
                    best, row = squared, j
            if row >= 0:
                is_near[s, i] = True
                found[i], highest[i] = max(found[i], kinds[row]), max(highest[i], trust[s])
    return found, highest, is_near
