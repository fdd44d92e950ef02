# SPDX-License-Identifier: Apache-2.0
"""Greedy groups of tokens by the distance of their proposed centres, in a compiled loop."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import F32x1, F32x2, I64x1, njit


@njit(cache=True, nogil=True)
def group_by_distance(goal: F32x2, ego: I64x1, order: I64x1, radius_m: F32x1, head: I64x1) -> None:  # pragma: no cover
    """Fill head (N,) with the token that leads the group of each token of order (n,); the others keep what they have.

    In this order, a token joins the nearest head of its ego within its radius of its goal (N, 2), and leads a group otherwise.
    """
    heads, count = np.empty(order.shape[0], np.int64), 0
    for place in range(order.shape[0]):
        i = order[place]
        nearest, best = -1, radius_m[i] * radius_m[i]
        for k in range(count):
            j = heads[k]
            if ego[j] == ego[i]:
                dx, dy = goal[i, 0] - goal[j, 0], goal[i, 1] - goal[j, 1]
                distance = dx * dx + dy * dy
                if distance < best:
                    nearest, best = j, distance
        if nearest < 0:
            heads[count] = i
            count += 1
            nearest = i
        head[i] = nearest
