# SPDX-License-Identifier: Apache-2.0
"""Fewer points where a line is straight: Douglas and Peucker (1973), on all elements of a map at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import MapElements
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.ops.polyline import select_vertices


def simplify_map(vector_map: VectorMap, tolerance_m: float) -> VectorMap:
    """Return the map with a subset of its points, none of those left out farther than tolerance_m from the line that remains.

    Ends of lines and the first point of a ring stay, with the ring's point that is farthest from it.
    """
    if not tolerance_m >= 0:
        raise ConfigError(f"Expected a tolerance of 0 m or more; got {tolerance_m}.")
    e = vector_map.elements
    kept = np.zeros(len(e.points), np.bool_)
    for start, end, closed in zip(e.offsets, e.offsets[1:], e.closed):
        if start < end:
            points = e.points[start:end]
            kept[start:end] = _select_ring(points, tolerance_m) if closed else select_vertices(points, tolerance_m)
    # A ring that would fall together into a line stays as it is.
    flat = e.closed & (np.bincount(e.element_of_point, kept, len(e)) < 3)
    kept |= flat[e.element_of_point]
    offsets = np.concatenate(([0], np.cumsum(kept)))[e.offsets]
    elements = MapElements(e.kind, offsets, e.points[kept], e.score, e.sigma[kept], e.style)
    return replace(vector_map, elements=elements, point_evidence=vector_map.point_evidence.take(np.flatnonzero(kept)))


def _select_ring(points: NDArray[np.float64], tolerance_m: float) -> NDArray[np.bool_]:
    """Return (P,) which points of a ring stay: it is cut at its first point and at the one farthest from that."""
    far = int(np.square(points - points[0]).sum(1).argmax())
    there, back = points[: far + 1], np.concatenate((points[far:], points[:1]))
    kept = np.zeros(len(points), np.bool_)
    kept[: far + 1] = select_vertices(there, tolerance_m)
    kept[far:] |= select_vertices(back, tolerance_m)[:-1]
    return kept
