# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``claim_tracks``."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import F64x1, I8x2, I64x1, U8x1, njit, set_row


@njit(cache=True, nogil=True)
def add_checks(
    checks: I8x2,
    times_ns: tuple[I64x1, I64x1, I64x1],
    track: I64x1,
    evidence: U8x1,
    numbers: tuple[int, int, int, int, int],
) -> tuple[I8x2, I64x1, I64x1, I64x1, I64x1]:  # pragma: no cover
    """Return the checks and times of the tracks of N claims, then of those that are left, and the rows of the latter among the K.

    checks (K, NUM_CHECKS), times_ns (K,) claimed, supported, refuted: of the tracks before. track, evidence: (N,) of claims.
    numbers: the time now, the maximum time without a claim, the maximum number of tracks, and the values of SUPPORTED and REFUTED.
    """
    claimed_ns, supported_ns, refuted_ns = times_ns
    now_ns, max_unclaimed_ns, max_tracks, is_supported, is_refuted = numbers
    num, is_left = len(track), np.ones(len(checks), np.bool_)
    for i in range(num):
        if track[i] >= 0:
            is_left[track[i]] = False
    rows, count = np.empty(len(checks), np.int64), 0
    for k in range(len(checks)):
        if is_left[k] and abs(now_ns - claimed_ns[k]) <= max_unclaimed_ns and num + count < max_tracks:
            rows[count] = k
            count += 1
    width = checks.shape[1]
    found = np.full((num + count, width), -1, np.int8)
    claimed, supported, refuted = (
        np.full(num + count, now_ns),
        np.zeros(num + count, np.int64),
        np.zeros(num + count, np.int64),
    )
    for i in range(num):
        found[i, 0] = evidence[i]
        if track[i] >= 0:
            set_row(found[i, 1:], checks[track[i]])
            supported[i], refuted[i] = supported_ns[track[i]], refuted_ns[track[i]]
        if evidence[i] == is_supported:
            supported[i] = now_ns
        if evidence[i] == is_refuted:
            refuted[i] = now_ns
    for i in range(count):
        set_row(found[num + i], checks[rows[i]])
        claimed[num + i] = claimed_ns[rows[i]]
        supported[num + i], refuted[num + i] = supported_ns[rows[i]], refuted_ns[rows[i]]
    return found, claimed, supported, refuted, rows[:count]


@njit(cache=True, nogil=True)
def count_refuted(
    checks: I8x2, score: F64x1, min_score: float, refuted: int, exonerating: tuple[int, int]
) -> I64x1:  # pragma: no cover
    """Return (K,) the number of refuted checks of each track; 0 of a lower score, and where one of its checks is exonerating."""
    out = np.zeros(len(checks), np.int64)
    for k in range(len(checks)):
        if not score[k] >= min_score:
            continue
        for i in range(checks.shape[1]):
            out[k] += checks[k, i] == refuted
            if checks[k, i] == exonerating[0] or checks[k, i] == exonerating[1]:
                out[k] = 0
                break
    return out
