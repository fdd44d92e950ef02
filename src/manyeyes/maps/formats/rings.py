# SPDX-License-Identifier: Apache-2.0
"""The two long sides of a crossing's ring, which several formats store in place of the ring."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def split_long_sides(ring: Floats) -> tuple[Floats, Floats]:
    """Return two polylines (K, 2) of an open ring, side by side in one direction, left first: what lies between its two short
    ends.

    A quadrilateral gives its two longer opposite edges. Any other ring is cut at its two ends along its principal axis.
    """
    if len(ring) == 4:
        edges = np.roll(ring, -1, axis=0) - ring
        length = np.hypot(edges[:, 0], edges[:, 1])
        start = 0 if length[0] + length[2] >= length[1] + length[3] else 1
        one, other = ring[[start, start + 1]], ring[[(start + 3) % 4, start + 2]]
    else:
        centred = ring - ring.mean(0)
        axis = np.linalg.svd(centred, full_matrices=False)[2][0]
        # Of an axis only the line is known; pointing it the same way always keeps files equal.
        axis = axis if tuple(axis) > (0.0, 0.0) else -axis
        along = centred @ axis
        low, high = int(along.argmin()), int(along.argmax())
        ahead = np.roll(ring, -low, axis=0)
        at = (high - low) % len(ring)
        one, other = ahead[: at + 1], np.concatenate((ahead[at:], ahead[:1]))[::-1]
    across = other.mean(0) - one.mean(0)
    step = one[-1] - one[0]
    other_is_left = step[0] * across[1] - step[1] * across[0] > 0
    return (other, one) if other_is_left else (one, other)
