# SPDX-License-Identifier: Apache-2.0
"""The part of the truth that was there to be seen: the union of all views, after GlobalMapNet's protocol (2024).

Views are placed by the *true* poses: the sensors measured from there, whatever the prior poses were. Open lines are cut at the
border of the area and keep parts of at least 2 m; a crossing is kept whole when at least half of its area lies inside, since
half a crossing is no truth that any map should be held against.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, MapElements

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "cutting the truth to what was observed")

Floats = NDArray[np.float64]
MIN_PART_LENGTH_M, MIN_CROSSING_FRACTION = 2.0, 0.5


def compute_observed_area(views: Sequence[Floats], poses: Floats) -> BaseGeometry:
    """Return the union of field-of-view polygons (K, 2), agents' frames, at true poses (N, 3) of x, y, yaw."""
    shapely = _shapely()
    polygons = []
    for view, (x, y, yaw) in zip(views, np.asarray(poses, dtype=np.float64)):
        c, s = np.cos(yaw), np.sin(yaw)
        polygons.append(shapely.polygons(np.asarray(view) @ np.array([[c, s], [-s, c]]) + [x, y]))
    return shapely.union_all(polygons)


def clip_to_area(elements: MapElements, area: BaseGeometry) -> MapElements:
    """Return the elements inside an area; scores and styles are kept."""
    shapely = _shapely()
    shapely.prepare(area)
    rows: list[int] = []
    parts: list[Floats] = []
    for row in range(len(elements)):
        points = elements.polyline(row)
        if elements.kind[row] == CROSSING:
            ring = shapely.polygons(points)
            if ring.is_valid and shapely.area(shapely.intersection(ring, area)) >= MIN_CROSSING_FRACTION * shapely.area(
                ring
            ):
                rows.append(row)
                parts.append(points)
            continue
        line = shapely.linestrings(points)
        if shapely.covers(area, line):
            rows.append(row)
            parts.append(points)
            continue
        inside = shapely.line_merge(shapely.intersection(line, area))
        for piece in shapely.get_parts(inside):
            if piece.geom_type == "LineString" and piece.length >= MIN_PART_LENGTH_M:
                rows.append(row)
                parts.append(shapely.get_coordinates(piece))
    return replace_geometry(elements, rows, parts)


def replace_geometry(elements: MapElements, rows: Sequence[int], parts: Sequence[Floats]) -> MapElements:
    """Return elements like those at the rows, each with another geometry (n, 2); sigma is the mean of the old points'."""
    index = np.asarray(rows, dtype=np.int64)
    mean = np.add.reduceat(elements.sigma, elements.offsets[:-1]) / elements.counts if len(elements) else np.zeros(0)
    sigma = np.repeat(mean[index], [len(part) for part in parts]) if len(parts) else np.zeros(0)
    return MapElements.of(parts, elements.kind[index], elements.score[index], sigma, elements.style[index])
