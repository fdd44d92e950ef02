# SPDX-License-Identifier: Apache-2.0
"""Published elements as a Lanelet2 map in OSM XML, which the ``lanelet2`` package reads back.

Dividers, boundaries and stop lines become tagged line strings; two lines that bound a lane (:mod:`manyeyes.maps.formats.lanes`)
become a lanelet, in no direction of travel, as lines do not tell it; a crossing becomes a lanelet of subtype ``crosswalk``
between its two long sides. Source: Lanelet2 documentation, "Linestring Tagging" and "Lanelet and Area Tagging".
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_write
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DASHED, DIVIDER, DOUBLE, SOLID, STOP_LINE, STYLES
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.formats.attributes import Attributes
from manyeyes.maps.formats.lanes import find_lane_pairs
from manyeyes.maps.formats.rings import split_long_sides
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres

Tags = tuple[tuple[str, str], ...]

_TYPE = {DIVIDER: "line_thin", BOUNDARY: "road_border", STOP_LINE: "stop_line"}
_SUBTYPE = {SOLID: "solid", DASHED: "dashed", DOUBLE: "solid_solid"}
_ROAD: Tags = (
    ("type", "lanelet"),
    ("subtype", "road"),
    ("location", "urban"),
    ("one_way", "no"),
    ("participant:vehicle", "yes"),
)
_CROSSWALK: Tags = (
    ("type", "lanelet"),
    ("subtype", "crosswalk"),
    ("location", "urban"),
    ("one_way", "no"),
    ("participant:pedestrian", "yes"),
)


def write_lanelet2(vector_map: VectorMap, path: Path | str) -> None:
    """Write the published elements as an OSM file; ``local_x`` and ``local_y`` of a node are metres in the map's frame."""
    m = vector_map.select_published()
    writer = _Writer(m)
    e = m.elements
    way_of = {row: writer.way(e.polyline(row), _line_tags(m, row)) for row in np.flatnonzero(~e.closed).tolist()}
    for pair in find_lane_pairs(m):
        writer.lanelet(way_of[pair.left], way_of[pair.right], _ROAD)
    for row in np.flatnonzero(e.kind == CROSSING).tolist():
        marking: Tags = (("type", "pedestrian_marking"), ("manyeyes:id", writer.ids[row]))
        left, right = (writer.way(side, marking) for side in split_long_sides(e.polyline(row)))
        writer.lanelet(left, right, _CROSSWALK)
    atomic_write(Path(path), writer.text().encode())


def _line_tags(m: VectorMap, row: int) -> Tags:
    kind = int(m.elements.kind[row])
    style = int(m.elements.style[row].argmax())
    tags = [("type", _TYPE[kind])]
    # A divider without a known style is exported without paint type: virtual lines are not painted.
    if kind == DIVIDER:
        tags = [("type", "virtual")] if STYLES[style] == "none" else [*tags, ("subtype", _SUBTYPE[style])]
    tags.append(("manyeyes:id", m.id[row].tobytes().hex()))
    return tuple(tags)


class _Writer:
    """Nodes, ways and relations with ids from 1 on, as an OSM file wants them: nodes first."""

    def __init__(self, m: VectorMap) -> None:
        self.origin = (m.frame.latitude, m.frame.longitude)
        self.ids = Attributes.of(m).id.tolist()
        self.count = 0
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.relations: list[str] = []

    def way(self, line: NDArray[np.float64], tags: Tags) -> int:
        """Add a line string with its own nodes; its id."""
        references = []
        degrees = degrees_from_metres(line, self.origin).tolist()
        for (latitude, longitude), (x, y) in zip(degrees, line.tolist()):
            node = self._next()
            references.append(f'    <nd ref="{node}"/>\n')
            local = _tags((("local_x", f"{x:.4f}"), ("local_y", f"{y:.4f}"), ("ele", "0")))
            self.nodes.append(
                f'  <node id="{node}" visible="true" version="1" lat="{latitude:.10f}" lon="{longitude:.10f}">\n{local}  </node>\n'
            )
        way = self._next()
        self.ways.append(f'  <way id="{way}" visible="true" version="1">\n{"".join(references)}{_tags(tags)}  </way>\n')
        return way

    def lanelet(self, left: int, right: int, tags: Tags) -> None:
        """Add a lanelet between two ways."""
        members = "".join(
            f'    <member type="way" ref="{way}" role="{role}"/>\n' for way, role in ((left, "left"), (right, "right"))
        )
        self.relations.append(
            f'  <relation id="{self._next()}" visible="true" version="1">\n{members}{_tags(tags)}  </relation>\n'
        )

    def text(self) -> str:
        """Return the OSM file as text."""
        body = "".join((*self.nodes, *self.ways, *self.relations))
        return f'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" generator="manyeyes">\n{body}</osm>\n'

    def _next(self) -> int:
        self.count += 1
        return self.count


def _tags(tags: Tags) -> str:
    return "".join(f"    <tag k={quoteattr(key)} v={quoteattr(value)}/>\n" for key, value in tags)
