# SPDX-License-Identifier: Apache-2.0
"""Free ranges about a LiDAR (``datatypes.sight``): measured in a sweep, and compared with stated boxes.

The bounds of a ray that passes at the height of a vehicle are those of ``box_rays``. A range is free only if in each part of its
sector, at each step, some ray passed at that height and returned from behind, and none returned from that height before.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes._jit import F64x1, F64x2
from manyeyes.datatypes.sight import MIN_FREE_M, NUM_SECTORS, STEP_M, Sight
from manyeyes.ops.lidar._free_range_kernels import find_free_boxes, measure_steps
from manyeyes.ops.lidar.box_rays import BOTTOM_M, MIN_BEHIND_M, TOP_M

NUM_PARTS = 3
"""Parts of a sector, of which each has rays of its own: a gap of 0.7 degrees between rays states nothing."""
LOWEST_VEHICLE_M = 1.6
"""Height of the lowest vehicles: a ray above LOWEST_VEHICLE_M - TOP_M may have passed over one."""
MAX_OBSTACLE_M = 2.5
"""Returns above are of bridges, signs and trees, under which rays pass."""
_LIMITS = np.array([STEP_M, MIN_FREE_M, BOTTOM_M, LOWEST_VEHICLE_M - TOP_M, MAX_OBSTACLE_M, MIN_BEHIND_M])


def measure_sight(points: Tensor, sensor_height_m: float) -> Sight:
    """Return the free ranges about a LiDAR at (0, 0, sensor_height_m) from its returns (N, 3), z = 0 is the road."""
    xyz = np.ascontiguousarray(points.numpy(), np.float32)
    return Sight(measure_steps(xyz, float(sensor_height_m), NUM_SECTORS, NUM_PARTS, _LIMITS))


def find_free(sight: Sight, boxes: F64x2, margin_m: F64x1) -> NDArray[np.bool_]:
    """Return (K,) which boxes a sight states to be free: the whole footprint, enlarged by the margin (K,), metres.

    boxes: (K, 7) centre, size and yaw, in the frame of the sight. A footprint nearer than MIN_FREE_M is never free.
    """
    return find_free_boxes(sight.steps, np.ascontiguousarray(boxes), np.ascontiguousarray(margin_m), STEP_M, MIN_FREE_M)


def measure_sight_reference(points: Tensor, sensor_height_m: float) -> Sight:
    """Do the same with every ray at every step of its part of a sector."""
    step, first_m, bottom, top, max_obstacle, behind = _LIMITS
    num_columns, edges = NUM_SECTORS * NUM_PARTS, torch.arange(256, device="cpu").double() * step
    xyz = points.double()
    length, drop = xyz[:, :2].norm(dim=1), sensor_height_m - xyz[:, 2]
    free_m = length * (1 - behind / torch.hypot(length, drop)).clamp_min(0)
    turns = torch.atan2(xyz[:, 1], xyz[:, 0]) / (2 * math.pi)
    column = (torch.where(turns < 0, turns + 1, turns) * num_columns).long().clamp_max(num_columns - 1)
    steps = np.full(NUM_SECTORS, 255)
    for part in range(num_columns):
        rays = column == part
        # Heights of the rays (R, 256) at the edges of the steps.
        height = sensor_height_m - drop[rays, None] * edges / length[rays, None]
        inside = (height >= bottom - 1e-9) & (height <= top + 1e-9) & (edges <= free_m[rays, None])
        is_passed = (inside[:, :-1] & inside[:, 1:]).any(0)
        is_passed[edges[:-1] < first_m] = True
        is_stop = (xyz[rays, 2] >= bottom) & (xyz[rays, 2] <= max_obstacle)
        reach = 255 if bool(is_passed.all()) else int((~is_passed).nonzero()[0])
        stops = (free_m[rays][is_stop] / step).long().tolist()
        steps[part // NUM_PARTS] = min(steps[part // NUM_PARTS], reach, *stops, 255)
    return Sight(np.where(steps > math.ceil(first_m / step), steps, 0))


def find_free_reference(sight: Sight, boxes: Tensor, margin_m: Tensor, num_samples: int = 60) -> Tensor:
    """Do the same with a grid of points (num_samples, num_samples) on each footprint."""
    free = torch.zeros(len(boxes), dtype=torch.bool, device="cpu")
    unit = torch.linspace(-1, 1, num_samples, device="cpu").double()
    for row, (box, margin) in enumerate(zip(boxes.double(), margin_m.tolist())):
        a, b = torch.meshgrid(unit * (box[3] / 2 + margin), unit * (box[4] / 2 + margin), indexing="ij")
        cosine, sine = box[6].cos(), box[6].sin()
        x, y = box[0] + a * cosine - b * sine, box[1] + a * sine + b * cosine
        turns = torch.atan2(y, x) / (2 * math.pi)
        sector = (torch.where(turns < 0, turns + 1, turns) * NUM_SECTORS).long().clamp_max(NUM_SECTORS - 1)
        distance, free_m = torch.hypot(x, y), torch.from_numpy(sight.free_m)
        free[row] = ((distance <= free_m[sector]) & (distance >= MIN_FREE_M)).all()
    return free
