# SPDX-License-Identifier: Apache-2.0
"""Rigid motions of many points in one compiled pass: a matrix product of three columns is far from the rate of memory."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import F32x1, F32x2, njit


@njit(cache=True, nogil=True)
def move_points(xyz: F32x2, rotation: F32x2, translation: F32x1) -> F32x2:  # pragma: no cover
    """Return rotation @ xyz[i] + translation for each point (N, 3), in float32 without fused products, as ``Transform.apply``."""
    out = np.empty_like(xyz)
    for i in range(xyz.shape[0]):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for c in range(3):
            out[i, c] = ((x * rotation[c, 0] + y * rotation[c, 1]) + z * rotation[c, 2]) + translation[c]
    return out
