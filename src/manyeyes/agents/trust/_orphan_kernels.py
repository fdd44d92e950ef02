# SPDX-License-Identifier: Apache-2.0
"""Compiled loop of ``orphans``."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F32x2, F64x1, F64x2, I64x1, njit


@njit(cache=True, nogil=True)
def clear_proposed(
    is_orphan: Boolx1,
    boxes: F64x2,
    features: F32x2,
    sites: F32x2,
    columns: I64x1,
    rotation: F64x2,
    shift: F64x1,
    numbers: F64x1,
) -> None:  # pragma: no cover
    """Clear the marks (N,) of the boxes (N, 2) within a radius of what tokens propose, features (T, C) at sites (T, 2).

    columns: of the heat logit, and the first of offset and velocity. rotation (3, 3), shift (3,): of the sender in the frame of the
    boxes. numbers: metres a unit of the offset and of the velocity, the minimum logit, and the radius, metres.
    """
    heat, offset, velocity = columns
    per_offset, per_velocity, min_logit, radius_m = numbers
    for row in range(len(features)):
        if not features[row, heat] >= min_logit:
            continue
        x = sites[row, 0] + per_offset * features[row, offset] + per_velocity * features[row, velocity]
        y = sites[row, 1] + per_offset * features[row, offset + 1] + per_velocity * features[row, velocity + 1]
        at_x = rotation[0, 0] * x + rotation[0, 1] * y + shift[0]
        at_y = rotation[1, 0] * x + rotation[1, 1] * y + shift[1]
        for i in range(len(boxes)):
            if is_orphan[i]:
                dx, dy = boxes[i, 0] - at_x, boxes[i, 1] - at_y
                is_orphan[i] = not dx * dx + dy * dy <= radius_m * radius_m


@njit(cache=True, nogil=True)
def find_near_sites(
    boxes: F64x2, sites: F32x2, rotation: F64x2, shift: F64x1, radius_m: float
) -> Boolx1:  # pragma: no cover
    """Return (N,) which of the boxes (N, 2) are within a radius of a site (T, 2); rotation and shift as above."""
    found = np.zeros(len(boxes), np.bool_)
    for row in range(len(sites)):
        x, y = float(sites[row, 0]), float(sites[row, 1])
        at_x = rotation[0, 0] * x + rotation[0, 1] * y + shift[0]
        at_y = rotation[1, 0] * x + rotation[1, 1] * y + shift[1]
        for i in range(len(boxes)):
            dx, dy = boxes[i, 0] - at_x, boxes[i, 1] - at_y
            found[i] |= dx * dx + dy * dy <= radius_m * radius_m
    return found
