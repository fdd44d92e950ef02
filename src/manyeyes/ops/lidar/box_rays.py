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

from manyeyes._jit import F32x2, F64x1, F64x2, I64x2
from manyeyes.datatypes import Boxes
from manyeyes.ops.lidar import _box_ray_kernels
from manyeyes.ops.lidar._box_ray_kernels import count_rays

BOTTOM_M, TOP_M = 0.4, 0.3
"""Rays nearer to the bottom or to the top of a box do not count as passing: the ground, and errors of its height. Returns hit it
from BOTTOM_M above its bottom to TOP_M above its top."""
MIN_BEHIND_M = 0.5
"""A ray passes if it returns from at least this far behind the core of a box."""
EDGE_M = 0.3
"""Hits nearer to the edge of an enlarged footprint may be of something beside the box, and are no inner hits."""
_LIMITS = np.array([BOTTOM_M, TOP_M, MIN_BEHIND_M, EDGE_M])
GROUND_M = 0.3
"""Ground is within this distance of z = 0."""
MIN_RAISED_M, MAX_RAISED_M = 0.5, 4.0
"""A box is set on the ground if its bottom is farther off it than MIN_RAISED_M, more than annotated bottoms are, and at most
MAX_RAISED_M: beyond, it may stand on a bridge, or below one."""
GROUND_RADIUS_M, MIN_GROUND_RETURNS = 2.5, 5
"""Ground is seen at a box where so many of its returns lie within this distance of the centre."""
_GROUND_LIMITS = np.array([GROUND_M, MIN_RAISED_M, MAX_RAISED_M, GROUND_RADIUS_M, MIN_GROUND_RETURNS])


class BoxRays(NamedTuple):
    """Rays of K boxes. num_passing: (K,) int64, through the core, from behind it. num_hits: (K,) int64, from the hull; num_inner:
    (K,) int64, those EDGE_M or more inside it, or in the box itself.
    """

    num_passing: Tensor
    num_hits: Tensor
    num_inner: Tensor


def count_box_rays(points: Tensor, origin: Tensor, boxes: Boxes, margin_m: Tensor) -> BoxRays:
    """Count the rays that pass through and that hit each box.

    Args:
        points: (N, 3) returns. origin: (3,) of all rays. Both in the frame of the boxes, metres.
        boxes: (K,). A box whose enlarged footprint contains the origin has no rays.
        margin_m: (K,) error of each position: rays pass through a core whose footprint is smaller by it on every side, and hit a
            hull whose footprint is larger by it.
    """
    columns = torch.cat((boxes.center, boxes.size, boxes.yaw[:, None]), 1).double().numpy()
    xyz = np.ascontiguousarray(points.float().numpy())
    found = count_rays(xyz, origin.double().numpy(), columns, margin_m.double().numpy(), _LIMITS)
    return BoxRays(*torch.from_numpy(found).unbind(1))


def count_rays_of_columns(xyz: F32x2, sensor_height_m: float, boxes: F64x2, margin_m: F64x1) -> I64x2:
    """Return (K, 3), passing rays, hits and inner hits, of boxes (K, 7: centre, size, yaw) and returns (N, 3) of a LiDAR."""
    origin = np.array([0.0, 0.0, sensor_height_m])
    return count_rays(np.ascontiguousarray(xyz, np.float32), origin, boxes, margin_m, _LIMITS)


def place_on_ground(xyz: F32x2, boxes: F64x2) -> F64x2:
    """Return boxes (K, 7: centre, size, yaw) of which those off the ground are set on it, where the returns (N, 3) show it.

    Both in a levelled frame, with the ground at z = 0. A box that is stated below the ground or above it has no rays, whereas
    objects stand on it. Where no flat ground is seen, as on slopes, boxes stay as they are.
    """
    return _box_ray_kernels.place_on_ground(np.ascontiguousarray(xyz, np.float32), boxes, _GROUND_LIMITS)


def count_box_rays_reference(points: Tensor, origin: Tensor, boxes: Boxes, margin_m: Tensor) -> BoxRays:
    """Do the same with every ray of every box: the slab test of Kay and Kajiya (SIGGRAPH 1986)."""
    passing, hits, inner = list[int](), list[int](), list[int]()
    for row in range(len(boxes)):
        cosine, sine = boxes.yaw[row].double().cos(), boxes.yaw[row].double().sin()
        turn = torch.stack((torch.stack((cosine, sine)), torch.stack((-sine, cosine))))
        start, end = (
            torch.cat((delta[:, :2] @ turn.T, delta[:, 2:]), 1)
            for delta in (places.double() - boxes.center[row].double() for places in (origin[None], points))
        )
        half = boxes.size[row].double() / 2
        if (start[0, :2].abs() <= half[:2] + margin_m[row]).all():
            for counts in (passing, hits, inner):
                counts.append(0)
            continue
        is_high = (end[:, 2] >= BOTTOM_M - half[2]) & (end[:, 2] <= half[2] + TOP_M)
        for counts, margin in ((hits, margin_m[row]), (inner, (margin_m[row] - EDGE_M).clamp_min(0))):
            counts.append(int(((end[:, :2].abs() <= half[:2] + margin).all(1) & is_high).sum()))
        high = torch.cat((half[:2] - margin_m[row], half[2:] - TOP_M))
        low = torch.cat((-high[:2], BOTTOM_M - half[2:]))
        step = end - start
        one, two = (low - start) / step, (high - start) / step
        enter, leave = torch.minimum(one, two).amax(1).clamp_min(0), torch.maximum(one, two).amin(1).clamp_max(1)
        is_passing = (enter < leave) & ((1 - leave) * step.norm(dim=1) >= MIN_BEHIND_M) & (high > low).all()
        passing.append(int(is_passing.sum()))
    return BoxRays(*torch.tensor((passing, hits, inner), dtype=torch.int64, device=points.device))
