# SPDX-License-Identifier: Apache-2.0
"""Rays of a sweep against boxes: how many pass through a box to a return behind it, and how many end in it.

Whether a false claim can be checked is measured by these, independently of any defence: a claim is checkable where at least
MIN_CHECKING_RAYS rays of an honest agent cross it in MIN_CHECKED_FRAMES of CHECK_WINDOW frames, and nothing real is near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import AgentFrame, Boxes

MIN_CHECKING_RAYS = 10
MIN_CHECKED_FRAMES, CHECK_WINDOW = 3, 5
MIN_BEHIND_M = 0.5
"""Minimum distance of a return behind a box, for its ray to have crossed the box."""
SHRINK_M = 0.3
"""A box is shrunk by this on every side, so that errors of its pose make no ray cross it that misses the object."""


@dataclass(frozen=True)
class RayCounts:
    """For each of N boxes: num_crossing rays (N,) that return behind it, num_inside (N,) returns in it, grown by SHRINK_M but at
    its bottom.
    """

    num_crossing: NDArray[np.int64]
    num_inside: NDArray[np.int64]


def count_rays(frame: AgentFrame, boxes: Boxes) -> RayCounts:
    """Count the rays of a frame against boxes (N) in the frame's axes; the sensor is at its height above the origin."""
    points = frame.points.xyz.numpy().astype(np.float64)
    origin = np.array([0.0, 0.0, frame.sensor_height_m])
    crossing, inside = (np.zeros(len(boxes), dtype=np.int64) for _ in range(2))
    for row in range(len(boxes)):
        yaw, center = float(boxes.yaw[row]), boxes.center[row].double().numpy()
        half = boxes.size[row].double().numpy() / 2
        near = points[_passes_near(points, center, float(np.hypot(*half[:2])) + 2 * SHRINK_M)]
        start, ends = _to_box(origin[None], center, yaw)[0], _to_box(near, center, yaw)
        # Returns of the ground are below the box.
        is_above = ends[:, 2] >= SHRINK_M - half[2]
        inside[row] = int(((np.abs(ends) <= half + SHRINK_M).all(1) & is_above).sum())
        crossing[row] = int(_crosses(start, ends, np.maximum(half - SHRINK_M, 0.1)).sum())
    return RayCounts(crossing, inside)


def is_checkable(num_rays: NDArray[np.int64]) -> bool:
    """Return whether a claim with these largest numbers of crossing rays (F,) of an honest agent in its frames is checkable."""
    seen = np.append(num_rays >= MIN_CHECKING_RAYS, False).astype(np.int64)
    return int(np.convolve(seen, np.ones(CHECK_WINDOW, dtype=np.int64)).max()) >= MIN_CHECKED_FRAMES


def _passes_near(points: NDArray[np.float64], center: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
    """Return (P,) whether the ray to each point comes within a horizontal radius of a place, before its end."""
    x, y, range_m = points[:, 0], points[:, 1], np.hypot(points[:, 0], points[:, 1])
    aside = np.abs(x * center[1] - y * center[0])
    ahead = x * center[0] + y * center[1]
    return (aside <= radius * range_m) & (ahead >= -radius * range_m) & (range_m >= np.hypot(*center[:2]) - radius)


def _to_box(points: NDArray[np.float64], center: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return points (P, 3) in the axes of a box."""
    delta = points - center
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack((delta[:, 0] * c + delta[:, 1] * s, delta[:, 1] * c - delta[:, 0] * s, delta[:, 2]), 1)


def _crosses(start: NDArray[np.float64], ends: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (P,) whether the segment from start to each end leaves the box of half sizes (3,) MIN_BEHIND_M before its end."""
    direction = ends - start
    length = np.linalg.norm(direction, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - start) / direction, (half - start) / direction
    low = np.where(direction == 0, np.where(np.abs(start) <= half, -np.inf, np.inf), np.minimum(first, second))
    high = np.where(direction == 0, np.where(np.abs(start) <= half, np.inf, -np.inf), np.maximum(first, second))
    enters, leaves = low.max(1), high.min(1)
    return (enters <= leaves) & (leaves > 0) & ((1.0 - leaves) * length >= MIN_BEHIND_M)
