# SPDX-License-Identifier: Apache-2.0
"""Compiled comparisons of positions of tokens and boxes, without a matrix of distances."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F32x1, F32x2, F64x1, F64x2, I64x1, njit


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
def propagate_centres(
    tokens: F32x2, xy: F32x2, columns: tuple[int, int], units: tuple[float, float], motion: tuple[F64x2, F64x1]
) -> F32x2:  # pragma: no cover
    """Return (N, 2): the centres that tokens (N, C) at xy (N, 2) propose, propagated by their velocities and moved.

    columns: first ones of offset and velocity. units: metres of one unit of the offset, and of the velocity by now. motion:
    rotation (3, 3) and translation (3,), applied to points at z = 0.
    """
    (offset, velocity), (cell_m, driven_m), (rotation, translation) = columns, units, motion
    out = np.empty((len(tokens), 2), np.float32)
    for i in range(len(tokens)):
        x = xy[i, 0] + tokens[i, offset] * np.float32(cell_m) + tokens[i, velocity] * np.float32(driven_m)
        y = xy[i, 1] + tokens[i, offset + 1] * np.float32(cell_m) + tokens[i, velocity + 1] * np.float32(driven_m)
        for axis in range(2):
            out[i, axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + translation[axis]
    return out


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
