# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of ``box_rays``: returns sorted by direction, and the rays of one box."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import F32x2, F64x1, F64x2, I64x1, I64x2, njit

NUM_SECTORS = 2048


@njit(cache=True, nogil=True, inline="always")
def _direction(x: float, y: float) -> float:  # pragma: no cover
    """Return a number in [0, 4) that rises with the direction of a vector; it costs no trigonometry."""
    total = abs(x) + abs(y)
    if total == 0.0:
        return 0.0
    if y >= 0.0:
        return y / total if x >= 0.0 else 1.0 - x / total
    return 2.0 - y / total if x < 0.0 else 3.0 + x / total


@njit(cache=True, nogil=True)
def sort_by_direction(points: F32x2, origin: F64x1, min_m: float) -> tuple[I64x1, I64x1]:  # pragma: no cover
    """Return rows of the points (N, 3) at least min_m away on the ground, by sector around the origin, and the first of each sector
    (NUM_SECTORS + 1).
    """
    rows, sector, count = np.empty(len(points), np.int64), np.empty(len(points), np.int64), 0
    first = np.zeros(NUM_SECTORS + 1, np.int64)
    for i in range(len(points)):
        dx, dy = points[i, 0] - origin[0], points[i, 1] - origin[1]
        if dx * dx + dy * dy < min_m * min_m:
            continue
        at = min(int(_direction(dx, dy) * (NUM_SECTORS / 4)), NUM_SECTORS - 1)
        rows[count], sector[count] = i, at
        first[at + 1] += 1
        count += 1
    for k in range(NUM_SECTORS):
        first[k + 1] += first[k]
    order, place = np.empty(count, np.int64), first[:-1].copy()
    for k in range(count):
        order[place[sector[k]]] = rows[k]
        place[sector[k]] += 1
    return order, first


@njit(cache=True, nogil=True)
def _find_nearest_m(origin: F64x1, box: F64x1, margin_m: float) -> float:  # pragma: no cover
    """Return a distance within which nothing of an enlarged box (7) lies, on the ground."""
    reach_x, reach_y = box[3] / 2 + margin_m, box[4] / 2 + margin_m
    dx, dy = origin[0] - box[0], origin[1] - box[1]
    return max(0.0, math.sqrt(dx * dx + dy * dy) - math.sqrt(reach_x * reach_x + reach_y * reach_y))


@njit(cache=True, nogil=True)
def count_rays(points: F32x2, origin: F64x1, boxes: F64x2, margin_m: F64x1, limits: F64x1) -> I64x2:  # pragma: no cover
    """Return (K, 3), passing rays, hits and inner hits of boxes (K, 7: centre, size, yaw).

    limits: the constants of ``box_rays``, in order.
    """
    out = np.zeros((len(boxes), 3), np.int64)
    if len(boxes) == 0 or len(points) == 0:
        return out
    min_m = math.inf
    for k in range(len(boxes)):
        min_m = min(min_m, _find_nearest_m(origin, boxes[k], margin_m[k]))
    order, first = sort_by_direction(points, origin, min_m)
    bottom, top, behind, edge = limits[0], limits[1], limits[2], limits[3]
    low, high, start, step = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(boxes)):
        cosine, sine = math.cos(boxes[k, 6]), math.sin(boxes[k, 6])
        dx, dy = origin[0] - boxes[k, 0], origin[1] - boxes[k, 1]
        start[0], start[1], start[2] = dx * cosine + dy * sine, dy * cosine - dx * sine, origin[2] - boxes[k, 2]
        half_length, half_width, half_height = boxes[k, 3] / 2, boxes[k, 4] / 2, boxes[k, 5] / 2
        reach_x, reach_y = half_length + margin_m[k], half_width + margin_m[k]
        inner_x, inner_y = max(reach_x - edge, half_length), max(reach_y - edge, half_width)
        if abs(start[0]) <= reach_x and abs(start[1]) <= reach_y:
            continue
        high[0], high[1], high[2] = half_length - margin_m[k], half_width - margin_m[k], half_height - top
        low[0], low[1], low[2] = -high[0], -high[1], -half_height + bottom
        has_core = high[0] > 0 and high[1] > 0 and high[2] > low[2]
        middle = _direction(-dx, -dy)
        nearest = _find_nearest_m(origin, boxes[k], margin_m[k])
        left, right = 0.0, 0.0
        for a in range(-1, 2, 2):
            for b in range(-1, 2, 2):
                x, y = a * reach_x * cosine - b * reach_y * sine - dx, a * reach_x * sine + b * reach_y * cosine - dy
                offset = (_direction(x, y) - middle + 6.0) % 4.0 - 2.0
                left, right = min(left, offset), max(right, offset)
        begin = math.floor((middle + left) * (NUM_SECTORS / 4)) - 1
        end = math.floor((middle + right) * (NUM_SECTORS / 4)) + 1
        for sector in range(begin, min(end, begin + NUM_SECTORS - 1) + 1):
            at = sector % NUM_SECTORS
            for row in range(first[at], first[at + 1]):
                i = order[row]
                dx, dy = points[i, 0] - origin[0], points[i, 1] - origin[1]
                if dx * dx + dy * dy < nearest * nearest:
                    continue
                dx, dy = points[i, 0] - boxes[k, 0], points[i, 1] - boxes[k, 1]
                x, y, z = dx * cosine + dy * sine, dy * cosine - dx * sine, points[i, 2] - boxes[k, 2]
                if abs(x) <= reach_x and abs(y) <= reach_y and low[2] <= z <= half_height + top:
                    out[k, 1] += 1
                    out[k, 2] += abs(x) <= inner_x and abs(y) <= inner_y
                if not has_core:
                    continue
                step[0], step[1], step[2] = x - start[0], y - start[1], z - start[2]
                enter, leave = 0.0, 1.0
                for axis in range(3):
                    if step[axis] == 0.0:
                        if start[axis] < low[axis] or start[axis] > high[axis]:
                            leave = -1.0
                        continue
                    one, two = (low[axis] - start[axis]) / step[axis], (high[axis] - start[axis]) / step[axis]
                    enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
                if enter < leave:
                    length = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
                    if (1.0 - leave) * length >= behind:
                        out[k, 0] += 1
    return out


@njit(cache=True, nogil=True)
def place_on_ground(points: F32x2, boxes: F64x2, limits: F64x1) -> F64x2:  # pragma: no cover
    """Return boxes (K, 7) of which those off the ground z = 0 are set on it where returns (N, 3) show it around them.

    limits: the constants of ``box_rays``, in order.
    """
    tolerance, lowest, highest, radius, min_returns = limits
    out = boxes.copy()
    for k in range(len(boxes)):
        base = abs(boxes[k, 2] - boxes[k, 5] / 2)
        if not lowest < base <= highest:
            continue
        count = 0
        for i in range(len(points)):
            if abs(points[i, 2]) <= tolerance:
                dx, dy = points[i, 0] - boxes[k, 0], points[i, 1] - boxes[k, 1]
                count += dx * dx + dy * dy <= radius * radius
        if count >= min_returns:
            out[k, 2] = boxes[k, 5] / 2
    return out
