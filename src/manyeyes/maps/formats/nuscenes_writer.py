# SPDX-License-Identifier: Apache-2.0
"""Published elements in the layout of the nuScenes map expansion (one JSON of tables joined by tokens), for its loaders.

Dividers stand under ``lane_divider``, crossings under ``ped_crossing``, stop lines, which that layout wants as areas, under
``stop_line`` as strips 0.4 m wide. Road boundaries have no table there, as loaders take them from the outline of
``road_segment``: they stand under ``road_boundary``, a table of ours. All tables of version 1.3 are there, unused ones
empty. Metres in the map's frame.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, DOUBLE, SOLID, STOP_LINE
from manyeyes.maps.elements.vector_map import VectorMap

Floats = NDArray[np.float64]

_SEGMENT = {SOLID: "SINGLE_SOLID_WHITE", DASHED: "SINGLE_DASHED_WHITE", DOUBLE: "DOUBLE_SOLID_WHITE"}
_EMPTY = (
    "drivable_area",
    "road_segment",
    "road_block",
    "lane",
    "lane_connector",
    "walkway",
    "carpark_area",
    "road_divider",
    "traffic_light",
)
_HALF_STRIP_M = 0.2


def write_nuscenes(vector_map: VectorMap, path: Path | str) -> None:
    """Write the published elements as one JSON file."""
    m = vector_map.select_published()
    e = m.elements
    tables = _Tables()
    for row in range(len(e)):
        token = m.id[row].tobytes().hex()
        kind, line = int(e.kind[row]), e.polyline(row)
        if kind == DIVIDER:
            tables.divider(token, line, _SEGMENT.get(int(e.style[row].argmax()), "NIL"))
        elif kind == BOUNDARY:
            tables.add("road_boundary", token, line_token=tables.line(token, line))
        elif kind == CROSSING:
            area = tables.polygon(token, line)
            tables.add("ped_crossing", token, polygon_token=area, road_segment_token="")
        elif kind == STOP_LINE:
            area = tables.polygon(token, _strip(line))
            tables.add(
                "stop_line", token, polygon_token=area, stop_line_type="STOP_SIGN", ped_crossing_tokens=[],
                traffic_light_tokens=[], road_block_token="",
            )  # fmt: skip
    edge = e.points.max(0).tolist() if len(e.points) else [0.0, 0.0]
    root: dict[str, Any] = {"version": "1.3", **{name: [] for name in _EMPTY}, **tables.rows}
    root |= {"canvas_edge": edge, "arcline_path_3": {}, "connectivity": {}}
    atomic_write(Path(path), json.dumps(root, separators=(",", ":"), allow_nan=False).encode())


class _Tables:
    """Rows by table; tokens are hashes of the element's id and what the row is to it."""

    def __init__(self) -> None:
        names = ("node", "line", "polygon", "lane_divider", "ped_crossing", "stop_line", "road_boundary")
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in names}

    def add(self, table: str, token: str, **columns: Any) -> str:
        """Append a row; its token."""
        self.rows[table].append({"token": token, **columns})
        return token

    def nodes(self, owner: str, points: Floats) -> list[str]:
        """Append points; their tokens."""
        return [
            self.add("node", _token(owner, f"node{k}"), x=x, y=y) for k, (x, y) in enumerate(points.round(4).tolist())
        ]

    def line(self, owner: str, points: Floats) -> str:
        """Append a line with its nodes; its token."""
        return self.add("line", _token(owner, "line"), node_tokens=self.nodes(owner, points))

    def polygon(self, owner: str, ring: Floats) -> str:
        """Append a polygon with its nodes; its token."""
        nodes = self.nodes(owner, ring)
        return self.add("polygon", _token(owner, "polygon"), exterior_node_tokens=nodes, holes=[])

    def divider(self, token: str, points: Floats, segment_type: str) -> None:
        """Append a divider with its line."""
        line = self.line(token, points)
        nodes = self.rows["line"][-1]["node_tokens"]
        segments = [{"node_token": node, "segment_type": segment_type} for node in nodes]
        self.add("lane_divider", token, line_token=line, lane_divider_segments=segments)


def _token(owner: str, part: str) -> str:
    return hashlib.blake2b(f"{owner}/{part}".encode(), digest_size=16).hexdigest()


def _strip(line: Floats) -> Floats:
    """Return the ring around a line, 0.2 m to each side."""
    step = line[-1] - line[0]
    normal = np.array([-step[1], step[0]]) / max(float(np.hypot(*step)), 1e-9) * _HALF_STRIP_M
    return np.concatenate((line + normal, (line - normal)[::-1]))
