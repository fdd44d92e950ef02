# SPDX-License-Identifier: Apache-2.0
"""A map in another frame: the same places on earth about another origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres, metres_from_degrees


def move_to_frame(vector_map: VectorMap, frame: MapFrame) -> VectorMap:
    """Return a map with its points in another frame; ids, evidence and relations stay."""
    if vector_map.frame == frame:
        return vector_map
    topology = replace(
        vector_map.topology, branch_xy=move_points(vector_map.topology.branch_xy, vector_map.frame, frame)
    )
    elements = vector_map.elements
    moved = elements.with_points(move_points(elements.points, vector_map.frame, frame))
    return replace(vector_map, frame=frame, elements=moved, topology=topology)


def move_points(xy: NDArray[np.float64], source: MapFrame, target: MapFrame) -> NDArray[np.float64]:
    """Return points (N, 2), metres in one frame, in metres of another."""
    degrees = degrees_from_metres(xy, (source.latitude, source.longitude))
    return metres_from_degrees(degrees[..., 0], degrees[..., 1], (target.latitude, target.longitude))
