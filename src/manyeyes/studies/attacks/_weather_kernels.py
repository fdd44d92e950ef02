# SPDX-License-Identifier: Apache-2.0
"""Compiled loop of ``weather``."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import Boolx1, F32x2, F64x2, njit


@njit(cache=True, nogil=True)
def find_window_returns(
    points: F32x2, boxes: F64x2, low: float, high: float, margin_m: float
) -> Boolx1:  # pragma: no cover
    """Return (P,) which points (P, 3) lie in boxes (N, 7: centre, size, yaw), enlarged by a margin, between two fractions of their
    height.
    """
    found, n = np.zeros(len(points), np.bool_), len(boxes)
    bottom, top, cosine, sine = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    lowest, highest = math.inf, -math.inf
    for k in range(n):
        floor = boxes[k, 2] - boxes[k, 5] / 2
        bottom[k], top[k] = floor + low * boxes[k, 5], floor + high * boxes[k, 5]
        cosine[k], sine[k] = math.cos(boxes[k, 6]), math.sin(boxes[k, 6])
        lowest, highest = min(lowest, bottom[k]), max(highest, top[k])
    for i in range(len(points)):
        z = points[i, 2]
        if not lowest <= z <= highest:
            continue
        for k in range(n):
            if not bottom[k] <= z <= top[k]:
                continue
            dx, dy = points[i, 0] - boxes[k, 0], points[i, 1] - boxes[k, 1]
            if abs(dx * cosine[k] + dy * sine[k]) > boxes[k, 3] / 2 + margin_m:
                continue
            if abs(dy * cosine[k] - dx * sine[k]) <= boxes[k, 4] / 2 + margin_m:
                found[i] = True
                break
    return found
