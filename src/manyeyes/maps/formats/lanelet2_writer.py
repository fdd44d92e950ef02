# SPDX-License-Identifier: Apache-2.0
"""Published elements as a Lanelet2 map in OSM XML, which the ``lanelet2`` package reads back and routes on.

Dividers, boundaries and stop lines become tagged line strings. Lines that bound a lane are cut into pieces that lanelets share
(:mod:`manyeyes.maps.formats.lane_sections`): a lanelet's neighbour has a side in common with it, its successor two points.
Connections over junctions and gaps are lanelets between virtual lines (:mod:`manyeyes.maps.formats.lane_connections`). A lanelet
of unknown direction has ``one_way=no``. A crossing becomes a lanelet of subtype ``crosswalk`` between its two long sides.

A stop line is a regulatory element ``traffic_sign`` of the lanelets that end at it, itself the sign and the line to stop at. A
crossing is one of subtype ``right_of_way``: its lanelet has it, the lanelets that cross it yield, at their stop line if they have
one. Source: Lanelet2 documentation, "Linestring Tagging", "Lanelet and Area Tagging", "Regulatory Element Tagging".
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
from manyeyes.maps.formats.lane_connections import connect_lanes
from manyeyes.maps.formats.lane_sections import build_lane_sections
from manyeyes.maps.formats.rings import split_long_sides
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres

Tags = tuple[tuple[str, str], ...]

_TYPE = {DIVIDER: "line_thin", BOUNDARY: "road_border", STOP_LINE: "stop_line"}
_SUBTYPE = {SOLID: "solid", DASHED: "dashed", DOUBLE: "solid_solid"}
_ROAD: Tags = (("type", "lanelet"), ("subtype", "road"), ("location", "urban"), ("participant:vehicle", "yes"))
_VIRTUAL: Tags = (("type", "virtual"),)
_CROSSWALK: Tags = (
    ("type", "lanelet"),
    ("subtype", "crosswalk"),
    ("location", "urban"),
    ("one_way", "no"),
    ("participant:pedestrian", "yes"),
)


def write_lanelet2(vector_map: VectorMap, path: Path | str, drives_on_right: bool = True) -> None:
    """Write the published elements as an OSM file; ``local_x`` and ``local_y`` of a node are metres in the map's frame.

    drives_on_right: the side of a double line on which traffic keeps, where no stop line gives the direction.
    """
    m = vector_map.select_published()
    writer = _Writer(m)
    graph = build_lane_sections(m)
    stops = connect_lanes(graph, m, drives_on_right)
    tags = {row: _line_tags(m, row) for row in np.flatnonzero(~m.elements.closed).tolist()}
    ways = [writer.way(p.points, tags.get(p.row, _VIRTUAL), (p.first, p.last)) for p in graph.pieces]
    way_of = {piece.row: way for piece, way in zip(graph.pieces, ways)}
    rules: list[list[int]] = [[] for _ in graph.sections]
    for row in sorted({row for row, _ in stops}):
        rule = writer.rule("traffic_sign", [("way", way_of[row], "refers"), ("way", way_of[row], "ref_line")])
        for number in sorted({section for stop, section in stops if stop == row}):
            rules[number].append(rule)
    lanelets = [writer.reserve() for _ in graph.sections]
    stop_of = {section: way_of[row] for row, section in stops}
    for row in np.flatnonzero(m.elements.kind == CROSSING).tolist():
        ring = m.elements.polyline(row)
        marking: Tags = (("type", "pedestrian_marking"), ("manyeyes:id", writer.ids[row]))
        sides = tuple(writer.way(side, marking) for side in split_long_sides(ring))
        crosswalk = writer.reserve()
        over = [k for k, section in enumerate(graph.sections) if _crosses(graph.middle_line(section, 60), ring)]
        own_rules = []
        if over:
            members = [("relation", crosswalk, "right_of_way"), *(("relation", lanelets[k], "yield") for k in over)]
            before = sorted({stop_of[k] for k in over if k in stop_of})
            own_rules = [writer.rule("right_of_way", members + [("way", way, "ref_line") for way in before[:1]])]
            for k in over:
                rules[k] += own_rules
        writer.lanelet(crosswalk, sides, _CROSSWALK, own_rules)
    for number, section, own_rules in zip(lanelets, graph.sections, rules):
        sides = (ways[section.left], ways[section.right])
        one_way: Tags = (("one_way", "yes" if section.direction else "no"),)
        writer.lanelet(number, sides[::-1] if section.direction < 0 else sides, _ROAD + one_way, own_rules)
    atomic_write(Path(path), writer.text().encode())


def _crosses(line: NDArray[np.float64], ring: NDArray[np.float64]) -> bool:
    """Return whether a point of a line (M, 2) lies inside an open ring (K, 2), by the even-odd rule."""
    low, high = ring.min(0), ring.max(0)
    inside = False
    for x, y in line[((line >= low) & (line <= high)).all(1)]:
        a, b = ring, np.roll(ring, -1, axis=0)
        beside = (a[:, 1] > y) != (b[:, 1] > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
        inside |= bool((beside & (at > x)).sum() % 2)
    return inside


def _line_tags(m: VectorMap, row: int) -> Tags:
    kind = int(m.elements.kind[row])
    style = int(m.elements.style[row].argmax())
    tags = [("type", _TYPE[kind])]
    # A divider without a known style is exported without paint type: virtual lines are not painted.
    if kind == DIVIDER:
        tags = [("type", "virtual")] if STYLES[style] == "none" else [*tags, ("subtype", _SUBTYPE[style])]
    if kind == STOP_LINE:
        # The regulatory element refers to the line as its sign, whose subtype is the sign's name.
        tags.append(("subtype", "stop_line"))
    tags.append(("manyeyes:id", m.id[row].tobytes().hex()))
    return tuple(tags)


class _Writer:
    """Nodes, ways and relations with ids from 1 on, as an OSM file wants them: nodes first."""

    def __init__(self, m: VectorMap) -> None:
        self.origin = (m.frame.latitude, m.frame.longitude)
        self.ids = Attributes.of(m).id.tolist()
        self.count = 0
        self.nodes: list[str] = []
        self.node_of_key: dict[tuple[int, int], int] = {}
        self.ways: list[str] = []
        self.relations: list[str] = []

    def way(
        self, line: NDArray[np.float64], tags: Tags, ends: tuple[tuple[int, int], tuple[int, int]] | None = None
    ) -> int:
        """Add a line string; its first and last node are shared with those of equal keys. Returns its id."""
        references = []
        degrees = degrees_from_metres(line, self.origin).tolist()
        keys = [None] * len(line) if ends is None else [ends[0], *[None] * (len(line) - 2), ends[1]]
        for (latitude, longitude), (x, y), key in zip(degrees, line.tolist(), keys):
            node = self.node_of_key.get(key) if key is not None else None
            if node is None:
                node = self.reserve()
                local = _tags((("local_x", f"{x:.4f}"), ("local_y", f"{y:.4f}"), ("ele", "0")))
                degree = f'lat="{latitude:.10f}" lon="{longitude:.10f}"'
                self.nodes.append(f'  <node id="{node}" visible="true" version="1" {degree}>\n{local}  </node>\n')
                if key is not None:
                    self.node_of_key[key] = node
            references.append(f'    <nd ref="{node}"/>\n')
        way = self.reserve()
        self.ways.append(f'  <way id="{way}" visible="true" version="1">\n{"".join(references)}{_tags(tags)}  </way>\n')
        return way

    def lanelet(self, number: int, sides: tuple[int, ...], tags: Tags, rules: list[int]) -> None:
        """Add a lanelet between two ways, left and right, with its regulatory elements."""
        members = [("way", way, role) for way, role in zip(sides, ("left", "right"), strict=True)]
        self._relation(number, members + [("relation", rule, "regulatory_element") for rule in rules], tags)

    def rule(self, subtype: str, members: list[tuple[str, int, str]]) -> int:
        """Add a regulatory element; its id."""
        number = self.reserve()
        tags = [("type", "regulatory_element"), ("subtype", subtype)]
        self._relation(number, members, tuple(tags))
        return number

    def _relation(self, number: int, members: list[tuple[str, int, str]], tags: Tags) -> None:
        text = "".join(f'    <member type="{kind}" ref="{ref}" role="{role}"/>\n' for kind, ref, role in members)
        self.relations.append(
            f'  <relation id="{number}" visible="true" version="1">\n{text}{_tags(tags)}  </relation>\n'
        )

    def text(self) -> str:
        """Return the OSM file as text."""
        body = "".join((*self.nodes, *self.ways, *self.relations))
        return f'<?xml version="1.0" encoding="UTF-8"?>\n<osm version="0.6" generator="manyeyes">\n{body}</osm>\n'

    def reserve(self) -> int:
        """Return an id that nothing has."""
        self.count += 1
        return self.count


def _tags(tags: Tags) -> str:
    return "".join(f"    <tag k={quoteattr(key)} v={quoteattr(value)}/>\n" for key, value in tags)
