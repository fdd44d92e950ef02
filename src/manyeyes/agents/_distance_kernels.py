# SPDX-License-Identifier: Apache-2.0
"""Compiled comparisons of positions of tokens and boxes, without a matrix of distances."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F32x1, F32x2, I64x1, njit


@njit(cache=True, nogil=True)
def count_earlier(place: F32x2, heat: F32x1, sent: F32x2, radius_m: float) -> I64x1:  # pragma: no cover
    """Return for each token (N,) the number of more confident tokens within the radius, plus 1 if one was sent (M, 2) there.

    place: (N, 2). Of equal heat (N,), the first is more confident.
    """
    n, limit = len(place), np.float32(radius_m * radius_m)
    count = np.zeros(n, np.int64)
    for i in range(n):
        for j in range(i):
            dx, dy = place[j, 0] - place[i, 0], place[j, 1] - place[i, 1]
            if dx * dx + dy * dy < limit:
                count[i if heat[j] >= heat[i] else j] += 1
        for j in range(len(sent)):
            dx, dy = sent[j, 0] - place[i, 0], sent[j, 1] - place[i, 1]
            if dx * dx + dy * dy < limit:
                count[i] += 1
                break
    return count


@njit(cache=True, nogil=True)
def has_neighbour(center: F32x2, others: F32x2, radius_m: float) -> Boolx1:  # pragma: no cover
    """Return for each centre (N, 2 or more) whether one of others (M, 2 or more) is within the radius."""
    found, limit = np.zeros(len(center), np.bool_), radius_m * radius_m
    for i in range(len(center)):
        x, y = np.float64(center[i, 0]), np.float64(center[i, 1])
        for j in range(len(others)):
            dx, dy = others[j, 0] - x, others[j, 1] - y
            if dx * dx + dy * dy <= limit:
                found[i] = True
                break
    return found
