# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``claim_offset``."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import F64x1, F64x2, njit


@njit(cache=True, nogil=True)
def score_shift(
    claims: F64x2, turned: F64x2, detections: F64x2, shift_x: float, shift_y: float, tolerance_m: float
) -> tuple[float, int, float]:  # pragma: no cover
    """Return the agreement of turned claims (N, 2) with detections (K, 2) after a shift, the number of claims that agree, and their
    mean displacement from where they were stated. A claim at a distance d adds 1 - (d / tolerance_m)^2.
    """
    score, number, moved, bound = 0.0, 0, 0.0, tolerance_m * tolerance_m
    for i in range(len(claims)):
        best, row = bound, -1
        for j in range(len(detections)):
            dx, dy = detections[j, 0] - turned[i, 0] - shift_x, detections[j, 1] - turned[i, 1] - shift_y
            if dx * dx + dy * dy < best:
                best, row = dx * dx + dy * dy, j
        if row >= 0:
            score, number = score + 1.0 - best / bound, number + 1
            moved += math.hypot(detections[row, 0] - claims[i, 0], detections[row, 1] - claims[i, 1])
    return score, number, moved / max(number, 1)


@njit(cache=True, nogil=True)
def search_offset(
    claims: F64x2, detections: F64x2, pivot: F64x1, turns: F64x1, limits: F64x1
) -> tuple[float, float, int, float]:  # pragma: no cover
    """Try every shift of one claim onto one detection after every turn about the pivot.

    limits: search_m, tolerance_m, max_offset_m, ratio, margin of ``OffsetConfig``. Returns the best agreement of displacements up
    to max_offset_m, the best of larger ones, and the number of pairs and the displacement of the latter.
    """
    search_m, tolerance_m, max_offset_m, ratio, margin = limits
    near, _, _ = score_shift(claims, claims, detections, 0.0, 0.0, tolerance_m)
    far, far_pairs, far_m = 0.0, 0, 0.0
    reachable = np.zeros(len(claims), np.bool_)
    for i in range(len(claims)):
        for j in range(len(detections)):
            dx, dy = detections[j, 0] - claims[i, 0], detections[j, 1] - claims[i, 1]
            if dx * dx + dy * dy <= search_m * search_m:
                reachable[i] = True
                break
    kept = claims[reachable]
    # No offset can do better than all claims that have a detection within reach.
    if near * ratio + margin >= len(kept):
        return near, far, far_pairs, far_m
    turned = np.empty_like(kept)
    for turn in turns:
        cosine, sine = math.cos(turn), math.sin(turn)
        for i in range(len(kept)):
            dx, dy = kept[i, 0] - pivot[0], kept[i, 1] - pivot[1]
            turned[i, 0] = pivot[0] + dx * cosine - dy * sine
            turned[i, 1] = pivot[1] + dx * sine + dy * cosine
        for i in range(len(kept)):
            for j in range(len(detections)):
                dx, dy = detections[j, 0] - kept[i, 0], detections[j, 1] - kept[i, 1]
                if dx * dx + dy * dy > search_m * search_m:
                    continue
                shift_x, shift_y = detections[j, 0] - turned[i, 0], detections[j, 1] - turned[i, 1]
                score, pairs, moved = score_shift(kept, turned, detections, shift_x, shift_y, tolerance_m)
                if moved <= max_offset_m:
                    near = max(near, score)
                elif score > far:
                    far, far_pairs, far_m = score, pairs, moved
    return near, far, far_pairs, far_m
