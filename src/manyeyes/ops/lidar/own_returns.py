# SPDX-License-Identifier: Apache-2.0
"""Returns from the vehicle that carries the sensor."""

from __future__ import annotations

import math

import numpy as np
import torch

from manyeyes._jit import Boolx1, F32x2, F64x1, njit
from manyeyes.datatypes import AgentBody, PointCloud

OWN_RETURN_MARGIN_M = 0.1
"""Maximum distance of a return from the body that it is attributed to: noise of the range, and mirrors."""


def remove_own_returns(points: PointCloud, body: AgentBody | None, margin_m: float = OWN_RETURN_MARGIN_M) -> PointCloud:
    """Return the points without those in the body, in one frame; the same object if there is none, or the body is unknown."""
    if body is None:
        return points
    half = [value / 2 + margin_m for value in body.size]
    box = np.array([*body.center, math.cos(body.yaw_rad), math.sin(body.yaw_rad), *half])
    outside = _mark_outside(points.xyz.detach().contiguous().numpy(), box)
    return points if outside.all() else points[torch.from_numpy(outside)]


@njit(cache=True, nogil=True)
def _mark_outside(xyz: F32x2, box: F64x1) -> Boolx1:  # pragma: no cover
    """Return (N,) whether a point is outside a box: x, y, z of its middle, cosine and sine of its yaw, half its sizes."""
    outside = np.ones(len(xyz), np.bool_)
    radius = math.hypot(box[5], box[6])
    for p in range(len(xyz)):
        x, y = xyz[p, 0] - box[0], xyz[p, 1] - box[1]
        if abs(x) > radius or abs(y) > radius:
            continue
        along, aside = x * box[3] + y * box[4], y * box[3] - x * box[4]
        outside[p] = abs(along) > box[5] or abs(aside) > box[6] or abs(xyz[p, 2] - box[2]) > box[7]
    return outside
