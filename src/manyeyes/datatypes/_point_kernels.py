# SPDX-License-Identifier: Apache-2.0
"""Motions and selections of many points in one compiled pass each: tensors of three columns are far from the rate of memory."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F32x1, F32x2, njit


@njit(cache=True, nogil=True)
def move_points(xyz: F32x2, rotation: F32x2, translation: F32x1) -> F32x2:  # pragma: no cover
    """Return rotation @ xyz[i] + translation for each point (N, 3), in float32 without fused products, as ``Transform.apply``."""
    out = np.empty_like(xyz)
    for i in range(xyz.shape[0]):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for c in range(3):
            out[i, c] = ((x * rotation[c, 0] + y * rotation[c, 1]) + z * rotation[c, 2]) + translation[c]
    return out


@njit(cache=True, nogil=True)
def scale_points(xyz: F32x2, x: float, y: float, z: float) -> F32x2:  # pragma: no cover
    """Return points (N, 3) with each axis multiplied by its factor, rounded to float32."""
    out = np.empty_like(xyz)
    factors = np.float32(x), np.float32(y), np.float32(z)
    for i in range(xyz.shape[0]):
        for c in range(3):
            out[i, c] = xyz[i, c] * factors[c]
    return out


@njit(cache=True, nogil=True)
def keep_points(
    xyz: F32x2, intensity: F32x1, time_s: F32x1, kept: Boolx1
) -> tuple[F32x2, F32x1, F32x1]:  # pragma: no cover
    """Return the points (M, 3), intensities and times (M,) of those of N that are kept (N,)."""
    n = 0
    for k in kept:
        n += k
    # One row to spare: writing always and moving on only past a kept point costs no branch that is guessed wrong.
    points, brightness, times = (
        np.empty((n + 1, 3), np.float32),
        np.empty(n + 1, np.float32),
        np.empty(n + 1, np.float32),
    )
    at = 0
    for i in range(kept.shape[0]):
        points[at, 0], points[at, 1], points[at, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        brightness[at], times[at] = intensity[i], time_s[i]
        at += kept[i]
    return points[:n], brightness[:n], times[:n]
