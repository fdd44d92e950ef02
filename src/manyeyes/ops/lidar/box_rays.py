# SPDX-License-Identifier: Apache-2.0
"""Rays of a sweep and stated boxes: how many pass through each box, and how many end in it.

A ray that returns from behind a box refutes that something opaque is there. Missing returns say nothing: dark and wet surfaces
return nothing either.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import Boxes
from manyeyes.ops.lidar._box_ray_kernels import count_rays

BOTTOM_M, TOP_M = 0.4, 0.3
"""Rays nearer to the bottom or to the top of a box are not counted: the ground, and errors of its height."""
MIN_BEHIND_M = 0.5
"""A ray passes if it returns from at least this far behind the core of a box."""
GROW_M = 0.3
"""A ray hits if it returns from the box, enlarged by this."""
_LIMITS = np.array([BOTTOM_M, TOP_M, MIN_BEHIND_M, GROW_M])


class BoxRays(NamedTuple):
    """Rays of K boxes. num_passing: (K,) int64, through the core, from behind it. num_hits: (K,) int64, from the box."""

    num_passing: Tensor
    num_hits: Tensor


def count_box_rays(points: Tensor, origin: Tensor, boxes: Boxes, shrink_m: Tensor) -> BoxRays:
    """Count the rays that pass through and that hit each box.

    Args:
        points: (N, 3) returns. origin: (3,) of all rays. Both in the frame of the boxes, metres.
        boxes: (K,). A box that contains the origin, enlarged by GROW_M, has no rays.
        shrink_m: (K,) by how much the core of each box is smaller than its footprint on every side.
    """
    columns = torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1).double().numpy()
    xyz = np.ascontiguousarray(points.float().numpy())
    found = count_rays(xyz, origin.double().numpy(), columns, shrink_m.double().numpy(), _LIMITS)
    passing, hits = torch.from_numpy(found).unbind(1)
    return BoxRays(passing, hits)


def count_box_rays_reference(points: Tensor, origin: Tensor, boxes: Boxes, shrink_m: Tensor) -> BoxRays:
    """Do the same with every ray of every box: the slab test of Kay and Kajiya (SIGGRAPH 1986)."""
    passing, hits = list[int](), list[int]()
    for row in range(len(boxes)):
        cosine, sine = boxes.yaw[row].double().cos(), boxes.yaw[row].double().sin()
        turn = torch.stack((torch.stack((cosine, sine)), torch.stack((-sine, cosine))))
        start, end = (
            torch.cat((delta[:, :2] @ turn.T, delta[:, 2:]), 1)
            for delta in (places.double() - boxes.center[row].double() for places in (origin[None], points))
        )
        half = boxes.size[row].double() / 2
        if (start[0, :2].abs() <= half[:2] + GROW_M).all():
            passing.append(0)
            hits.append(0)
            continue
        is_hit = (end[:, :2].abs() <= half[:2] + GROW_M).all(1)
        hits.append(int((is_hit & (end[:, 2] >= BOTTOM_M - half[2]) & (end[:, 2] <= half[2] + GROW_M)).sum()))
        high = torch.cat((half[:2] - shrink_m[row], half[2:] - TOP_M))
        low = torch.cat((-high[:2], BOTTOM_M - half[2:]))
        step = end - start
        one, two = (low - start) / step, (high - start) / step
        enter, leave = torch.minimum(one, two).amax(1).clamp_min(0), torch.maximum(one, two).amin(1).clamp_max(1)
        is_passing = (enter < leave) & ((1 - leave) * step.norm(dim=1) >= MIN_BEHIND_M) & (high > low).all()
        passing.append(int(is_passing.sum()))
    return BoxRays(torch.tensor(passing, dtype=torch.int64), torch.tensor(hits, dtype=torch.int64))
