# SPDX-License-Identifier: Apache-2.0
"""Lines and rings cut to a convex polygon: what of them lies in a view. Needs no geometry library, so that an agent can."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def clip_line(line: Floats, polygon: Floats) -> list[Floats]:
    """Return the parts (K, 2) of a line (N, 2) inside an anticlockwise convex polygon (M, 2), in order along it.

    Source: Cyrus and Beck 1978. A part that only touches the polygon is none.
    """
    step = np.diff(line, axis=0)
    enter, leave = np.zeros(len(step)), np.ones(len(step))
    for corner, side in zip(polygon, np.roll(polygon, -1, axis=0) - polygon):
        inward = np.array([-side[1], side[0]])
        depth, rate = (line[:-1] - corner) @ inward, step @ inward
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -depth / rate
        enter = np.where(rate > 0, np.maximum(enter, at), enter)
        leave = np.where(rate < 0, np.minimum(leave, at), leave)
        leave = np.where((rate == 0) & (depth < 0), -1.0, leave)
    parts: list[list[Floats]] = []
    for k in np.flatnonzero(leave > enter).tolist():
        end = line[k] + leave[k] * step[k]
        goes_on = bool(parts) and enter[k] == 0.0 and k > 0 and leave[k - 1] == 1.0 and leave[k - 1] > enter[k - 1]
        if goes_on:
            parts[-1].append(end)
        else:
            parts.append([line[k] + enter[k] * step[k], end])
    return [np.array(part) for part in parts]


def clip_ring(ring: Floats, polygon: Floats) -> Floats:
    """What of an open ring (N, 2) lies inside an anticlockwise convex polygon (M, 2), as one open ring; (0, 2) where nothing does.

    Source: Sutherland and Hodgman 1974. Parts of a ring that is not convex stay joined along the polygon's edge.
    """
    for corner, side in zip(polygon, np.roll(polygon, -1, axis=0) - polygon):
        depth = (ring - corner) @ np.array([-side[1], side[0]])
        after, depth_after = np.roll(ring, -1, axis=0), np.roll(depth, -1)
        out = []
        for a, b, x, y in zip(ring, after, depth, depth_after):
            if x >= 0:
                out.append(a)
            if (x > 0 > y) or (x < 0 < y):
                out.append(a + (b - a) * (x / (x - y)))
        ring = np.array(out).reshape(-1, 2)
    return ring


def ring_area(ring: Floats) -> float:
    """Return the area of an open ring (N, 2), positive where it runs anticlockwise."""
    x, y = ring.T if len(ring) else np.zeros((2, 0))
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
