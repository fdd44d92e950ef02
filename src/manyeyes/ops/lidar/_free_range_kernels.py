# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``free_range``: free ranges of a sweep, and boxes within free ranges."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import Boolx1, F32x2, F64x1, F64x2, U8x1, njit


@njit(cache=True, nogil=True, inline="always")
def _azimuth(x: float, y: float) -> float:  # pragma: no cover
    """Return the azimuth of a vector in turns, in [0, 1]."""
    turns = math.atan2(y, x) / (2 * math.pi)
    return turns + 1.0 if turns < 0.0 else turns


@njit(cache=True, nogil=True)
def measure_steps(
    points: F32x2, height_m: float, num_sectors: int, num_parts: int, limits: F64x1
) -> U8x1:  # pragma: no cover
    """Return the free range of each sector in steps. limits: step, first range, bottom and top of the band that a ray passes
    through, top of what stops it, distance to a return that is not free; metres.
    """
    step, first_m, bottom, top, max_obstacle, behind = limits
    num_columns, num_bins = num_sectors * num_parts, 255
    # The rays that begin and end to pass, by column and step.
    change = np.zeros((num_columns, num_bins + 1), np.int32)
    stop = np.full(num_columns, num_bins, np.int64)
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        length = math.sqrt(x * x + y * y)
        drop = height_m - z
        ray = math.sqrt(length * length + drop * drop)
        if not (0.0 < ray < math.inf):
            continue
        column = min(int(_azimuth(x, y) * num_columns), num_columns - 1)
        free_m = length * max(0.0, 1.0 - behind / ray)
        if bottom <= z <= max_obstacle:
            stop[column] = min(stop[column], int(free_m / step))
        enter, leave = 0.0, 1.0
        if drop != 0.0:
            one, two = (height_m - top) / drop, (height_m - bottom) / drop
            enter, leave = max(0.0, min(one, two)), min(1.0, max(one, two))
        elif not bottom <= height_m <= top:
            continue
        begin = math.ceil(enter * length / step)
        end = min(math.floor(min(leave * length, free_m) / step), num_bins)
        if begin < end:
            change[column, begin] += 1
            change[column, end] -= 1
    first, steps = math.ceil(first_m / step), np.zeros(num_sectors, np.uint8)
    for sector in range(num_sectors):
        least = num_bins
        for column in range(sector * num_parts, (sector + 1) * num_parts):
            passing, reach = 0, num_bins
            for k in range(num_bins):
                passing += change[column, k]
                if k >= first and passing == 0:
                    reach = k
                    break
            least = min(least, reach, stop[column])
        steps[sector] = least if least > first else 0
    return steps


@njit(cache=True, nogil=True)
def find_free_boxes(
    steps: U8x1, boxes: F64x2, margin_m: F64x1, step_m: float, min_m: float
) -> Boolx1:  # pragma: no cover
    """Return (K,) whether the enlarged footprint of each box (K, 7: centre, size, yaw) lies within the free ranges."""
    num_sectors, free = len(steps), np.zeros(len(boxes), np.bool_)
    farthest, corner = np.empty(num_sectors), np.empty((4, 2))
    for k in range(len(boxes)):
        cosine, sine = math.cos(boxes[k, 6]), math.sin(boxes[k, 6])
        reach_x, reach_y = boxes[k, 3] / 2 + margin_m[k], boxes[k, 4] / 2 + margin_m[k]
        # The LiDAR in the frame of the box.
        x, y = -boxes[k, 0] * cosine - boxes[k, 1] * sine, boxes[k, 0] * sine - boxes[k, 1] * cosine
        gap_x, gap_y = max(abs(x) - reach_x, 0.0), max(abs(y) - reach_y, 0.0)
        if not gap_x * gap_x + gap_y * gap_y >= min_m * min_m:
            continue
        middle, left, right = _azimuth(boxes[k, 0], boxes[k, 1]), 0.0, 0.0
        for n in range(4):
            a, b = reach_x * (1 - n // 2 * 2), reach_y * (1 - n % 2 * 2)
            corner[n, 0], corner[n, 1] = (
                boxes[k, 0] + a * cosine - b * sine,
                boxes[k, 1] + a * sine + b * cosine,
            )
            offset = (_azimuth(corner[n, 0], corner[n, 1]) - middle + 1.5) % 1.0 - 0.5
            left, right = min(left, offset), max(right, offset)
        begin, end = math.floor((middle + left) * num_sectors), math.floor((middle + right) * num_sectors)
        farthest[:] = 0.0
        for n in range(4):
            at = min(int(_azimuth(corner[n, 0], corner[n, 1]) * num_sectors), num_sectors - 1)
            farthest[at] = max(farthest[at], math.sqrt(corner[n, 0] ** 2 + corner[n, 1] ** 2))
        # Between two sectors that the footprint covers, it ends where the ray between them leaves it.
        for edge in range(begin + 1, end + 1):
            angle = 2 * math.pi * edge / num_sectors
            toward_x = math.cos(angle) * cosine + math.sin(angle) * sine
            toward_y = math.sin(angle) * cosine - math.cos(angle) * sine
            leave = math.inf
            if toward_x != 0.0:
                leave = min(leave, max((reach_x - x) / toward_x, (-reach_x - x) / toward_x))
            if toward_y != 0.0:
                leave = min(leave, max((reach_y - y) / toward_y, (-reach_y - y) / toward_y))
            for at in ((edge - 1) % num_sectors, edge % num_sectors):
                farthest[at] = max(farthest[at], leave)
        is_free = True
        for sector in range(begin, end + 1):
            at = sector % num_sectors
            is_free &= farthest[at] <= steps[at] * step_m
        free[k] = is_free
    return free
