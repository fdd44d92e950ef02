# SPDX-License-Identifier: Apache-2.0
"""Published elements in the layout of an Argoverse 2 vector map (``log_map_archive_*.json``), for loaders of that data set.

The layout has no lines of their own, only lanes with two painted sides. Lines that bound a lane
(:mod:`manyeyes.maps.formats.lanes`) become that lane's sides; a divider that bounds none becomes the left side of a lane
3.5 m wide whose right side has paint NONE, so that no line is lost and none is made up. Boundaries have no paint; one that
closes becomes a ring of the drivable area, and all stand under ``road_boundaries``, a key of ours that other loaders pass
over. World axes: the map's frame.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, DOUBLE, SOLID
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.lanes import find_lane_pairs
from manyeyes.maps.formats.rings import split_long_sides

Floats = NDArray[np.float64]

_PAINT = {SOLID: "SOLID_WHITE", DASHED: "DASHED_WHITE", DOUBLE: "DOUBLE_SOLID_WHITE"}
_LANE_M = 3.5
_CLOSED_M = 1.0


def write_argoverse2(vector_map: VectorMap, path: Path | str) -> None:
    """Write the published elements as one JSON file."""
    m = vector_map.select_published()
    e = m.elements
    lanes: list[dict[str, Any]] = []
    used: set[int] = set()
    for pair in find_lane_pairs(m):
        right = e.polyline(pair.right)
        lanes.append(
            _lane(len(lanes) + 1, e.polyline(pair.left), _paint_name(m, pair.left),
                  right[::-1] if pair.right_is_reversed else right, _paint_name(m, pair.right))
        )  # fmt: skip
        used |= {pair.left, pair.right}
    for row in np.flatnonzero(e.kind == DIVIDER).tolist():
        if row not in used:
            line = e.polyline(row)
            lanes.append(_lane(len(lanes) + 1, line, _paint_name(m, row), _offset(line, -_LANE_M), "NONE"))
    boundaries = [e.polyline(row) for row in np.flatnonzero(e.kind == BOUNDARY).tolist()]
    rings = [line for line in boundaries if len(line) > 3 and np.hypot(*(line[0] - line[-1])) <= _CLOSED_M]
    sides = [split_long_sides(e.polyline(row)) for row in np.flatnonzero(e.kind == CROSSING).tolist()]
    root = {
        "pedestrian_crossings": {
            str(k): {"id": k, "edge1": _points(one), "edge2": _points(two)} for k, (one, two) in enumerate(sides, 1)
        },
        "lane_segments": {str(lane["id"]): lane for lane in lanes},
        "drivable_areas": {str(k): {"id": k, "area_boundary": _points(ring)} for k, ring in enumerate(rings, 1)},
        "road_boundaries": {str(k): {"id": k, "points": _points(line)} for k, line in enumerate(boundaries, 1)},
    }
    atomic_write(Path(path), json.dumps(root, separators=(",", ":"), allow_nan=False).encode())


def _paint_name(m: VectorMap, row: int) -> str:
    return _PAINT.get(int(m.elements.style[row].argmax()), "NONE") if m.elements.kind[row] == DIVIDER else "NONE"


def _lane(number: int, left: Floats, left_paint: str, right: Floats, right_paint: str) -> dict[str, Any]:
    return {
        "id": number,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": _points(left),
        "left_lane_mark_type": left_paint,
        "left_neighbor_id": None,
        "right_lane_boundary": _points(right),
        "right_lane_mark_type": right_paint,
        "right_neighbor_id": None,
        "predecessors": [],
        "successors": [],
    }


def _points(line: Floats) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 0.0} for x, y in line.round(4).tolist()]


def _offset(line: Floats, left_m: float) -> Floats:
    """Return the line moved to its left by so much, point by point along the mean of the two normals."""
    step = np.diff(line, axis=0)
    step /= np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]
    heading = np.concatenate((step[:1], step[:-1] + step[1:], step[-1:]))
    heading /= np.maximum(np.hypot(heading[:, 0], heading[:, 1]), 1e-9)[:, None]
    return line + left_m * np.stack((-heading[:, 1], heading[:, 0]), 1)
