# SPDX-License-Identifier: Apache-2.0
"""Compiled loop of ``orphans``."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import Boolx1, F32x2, F64x1, F64x2, I64x1, njit


@njit(cache=True, nogil=True)
def list_proposals(features: F32x2, sites: F32x2, columns: I64x1, numbers: F64x1) -> F64x2:  # pragma: no cover
    """Return the places and velocities (P, 4) that tokens propose, features (T, C) at sites (T, 2).

    columns: of the heat logit, and the first of offset and velocity. numbers: metres a unit of the offset and of the velocity, and
    the minimum logit.
    """
    heat, offset, velocity = columns
    per_offset, per_velocity, min_logit = numbers
    out, count = np.empty((len(features), 4)), 0
    for row in range(len(features)):
        if not features[row, heat] >= min_logit:
            continue
        for k in range(2):
            out[count, k] = sites[row, k] + per_offset * features[row, offset + k]
            out[count, 2 + k] = per_velocity * features[row, velocity + k]
        count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def clear_proposed(
    is_orphan: Boolx1, boxes: F64x2, proposals: F64x2, first: I64x1, motions: F64x2, radius_m: float
) -> None:  # pragma: no cover
    """Clear the marks (N,) of the boxes (N, 2) within a radius of the proposals (P, 4) of sources, one after the other.

    first: (S + 1,) of each source. motions: (S, 7) seconds since, the rotation (2, 2) by rows and the shift (2,) to the frame of
    the boxes.
    """
    x, y = np.empty(len(proposals)), np.empty(len(proposals))
    for source in range(len(motions)):
        seconds, cos_x, sin_x, sin_y, cos_y, shift_x, shift_y = motions[source]
        for row in range(first[source], first[source + 1]):
            at_x = proposals[row, 0] + seconds * proposals[row, 2]
            at_y = proposals[row, 1] + seconds * proposals[row, 3]
            x[row], y[row] = cos_x * at_x + sin_x * at_y + shift_x, sin_y * at_x + cos_y * at_y + shift_y
    for i in range(len(boxes)):
        if is_orphan[i]:
            for row in range(len(proposals)):
                dx, dy = boxes[i, 0] - x[row], boxes[i, 1] - y[row]
                if dx * dx + dy * dy <= radius_m * radius_m:
                    is_orphan[i] = False
                    break


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
