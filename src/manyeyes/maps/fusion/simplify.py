# SPDX-License-Identifier: Apache-2.0
"""Fewer points where a line is straight: Douglas and Peucker (1973), on all elements of a map at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from manyeyes._jit import Boolx1, F64x2, I64x1, njit
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.vector_map import VectorMap


def simplify_map(vector_map: VectorMap, tolerance_m: float) -> VectorMap:
    """The map with a subset of its points, none of those left out farther than tolerance_m from the line that remains.

    Ends of lines and the first point of a ring stay, with the ring's point that is farthest from it.
    """
    if not tolerance_m >= 0:
        raise ConfigError(f"Expected a tolerance of 0 m or more; got {tolerance_m}.")
    e = vector_map.elements
    kept = _select_points(e.points, e.offsets, e.closed, tolerance_m)
    # A ring that would fall together into a line stays as it is.
    flat = e.closed & (np.bincount(e.element_of_point, kept, len(e)) < 3)
    kept |= flat[e.element_of_point]
    offsets = np.concatenate(([0], np.cumsum(kept)))[e.offsets]
    elements = MapElements(e.kind, offsets, e.points[kept], e.score, e.sigma[kept], e.style)
    return replace(vector_map, elements=elements, point_evidence=vector_map.point_evidence.take(np.flatnonzero(kept)))


@njit(cache=True)
def _select_points(
    points: F64x2, offsets: I64x1, closed: Boolx1, tolerance: float
) -> Boolx1:  # pragma: no cover - compiled
    """(P,) bool: the points that stay."""
    kept = np.zeros(len(points), np.bool_)
    stack = np.zeros((2 * len(points) + 4, 2), np.int64)
    for row in range(len(offsets) - 1):
        start, end = offsets[row], offsets[row + 1]
        if end <= start:
            continue
        last = end - 1
        kept[start] = True
        depth = 0
        if closed[row]:
            far, max_squared = start, -1.0
            for k in range(start, end):
                squared = (points[k, 0] - points[start, 0]) ** 2 + (points[k, 1] - points[start, 1]) ** 2
                if squared > max_squared:
                    far, max_squared = k, squared
            kept[far] = True
            stack[0, 0], stack[0, 1] = start, far
            # ``end`` stands for the first point again: the ring's closing edge.
            stack[1, 0], stack[1, 1] = far, end
            depth = 2
        else:
            kept[last] = True
            stack[0, 0], stack[0, 1] = start, last
            depth = 1
        while depth:
            depth -= 1
            a, b = stack[depth, 0], stack[depth, 1]
            ax, ay = points[a]
            bx, by = points[start] if b == end else points[b]
            dx, dy = bx - ax, by - ay
            square = dx * dx + dy * dy
            far, max_squared = -1, tolerance * tolerance
            for k in range(a + 1, b):
                px, py = points[k, 0] - ax, points[k, 1] - ay
                along = 0.0 if square == 0.0 else min(max((px * dx + py * dy) / square, 0.0), 1.0)
                squared = (px - along * dx) ** 2 + (py - along * dy) ** 2
                if squared > max_squared:
                    far, max_squared = k, squared
            if far >= 0:
                kept[far] = True
                stack[depth, 0], stack[depth, 1] = a, far
                stack[depth + 1, 0], stack[depth + 1, 1] = far, b
                depth += 2
    return kept
