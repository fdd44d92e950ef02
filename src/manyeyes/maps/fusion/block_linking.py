# SPDX-License-Identifier: Apache-2.0
"""Link stations block by block, and stitch the links at the borders of blocks.

The ground is divided into squares. The links of the stations in a square are those that all stations within its halo give
(:mod:`manyeyes.maps.fusion.polyline_linking`, :mod:`manyeyes.maps.fusion.parallel_extension`); what is beyond has no effect. A link
across a border stays where both squares have it. So the map is defined by squares and halo, and it is the same for any tiling.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.map_element import DASHED
from manyeyes.maps.elements.vector_map import RETIRED
from manyeyes.maps.fusion.existence import EvidenceTable
from manyeyes.maps.fusion.parallel_extension import ParallelExtensionConfig, extend_parallel
from manyeyes.maps.fusion.polyline_linking import LinkConfig, find_links, trace_chains
from manyeyes.maps.fusion.stations import Area, StationTable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Place = tuple[int, int]


@dataclass(frozen=True, eq=False)
class LinkedStations:
    """The stations of blocks, with K rows of lines, and their links.

    table: stations with evidence, crossings and observed ground. is_observed: (K,) False for an inferred station, whose evidence is
    that of the end that it continues. linked: (K, 2) row of the station linked in front of and behind its own tangent; -1: none
    here. outside: (K, 2, 2) position of a linked station that is not among the rows, metres; NaN: none.
    """

    table: StationTable
    is_observed: Flags
    linked: Ints
    outside: Floats

    def take(self, rows: Ints) -> LinkedStations:
        """Return the chosen stations, ascending, with the links among them; crossings and ground stay."""
        place = np.full(len(self.table) + 1, -1)
        place[rows] = np.arange(len(rows))
        line = self.table.line_evidence.take(rows)
        table = replace(self.table, xy=self.table.xy[rows], tangent=self.table.tangent[rows], line_evidence=line)
        return LinkedStations(table, self.is_observed[rows], place[self.linked[rows]], self.outside[rows])


def find_block_area(block: Place, config: LinkConfig) -> Area:
    """Return the area (x0, y0, x1, y1; metres) of a block."""
    x, y = (float(k * config.block_m) for k in block)
    half = config.block_m / 2
    return x - half, y - half, x + half, y + half


def list_blocks(areas: Iterable[Area], config: LinkConfig) -> list[Place]:
    """List the blocks that areas overlap, ascending."""
    side, found = config.block_m, set[Place]()
    for x0, y0, x1, y1 in areas:
        columns, rows = (
            range(int((low + side / 2) // side), int(-(-(high + side / 2) // side)))
            for low, high in ((x0, x1), (y0, y1))
        )
        found.update(product(columns, rows))
    return sorted(found)


def link_in_blocks(table: StationTable, config: LinkConfig, extension: ParallelExtensionConfig) -> LinkedStations:
    """Link the stations of all areas block by block."""
    xy = np.concatenate((table.xy, table.ring_xy[table.ring_offsets[:-1]]))
    cells = table.observed_cells
    blocks = {(int(x), int(y)) for x, y in np.unique(np.floor(xy / config.block_m + 0.5).astype(np.int64), axis=0)}
    if len(cells):
        box = (
            float(cells[:, 1].min()),
            float(cells[:, 0].min()),
            float(cells[:, 2].max() + 1),
            float(cells[:, 0].max() + 1),
        )
        blocks.update(list_blocks([box], config))
    if not blocks:
        blocks = {(0, 0)}
    return stitch_blocks([link_block(table, block, config, extension) for block in sorted(blocks)])


def link_block(
    table: StationTable, block: Place, config: LinkConfig, extension: ParallelExtensionConfig
) -> LinkedStations:
    """Link the stations of a block; table: all stations within its halo, and possibly others."""
    area = find_block_area(block, config)
    near = table.take_area(area, config.block_halo_m)
    is_retired = near.line_evidence.state == RETIRED
    parts = [_link_rows(near, np.flatnonzero(chosen), config, extension) for chosen in (~is_retired, is_retired)]
    starts = np.cumsum([0, *(len(rows) for _, _, rows, _, _ in parts)])
    xy, tangent = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    rows, is_observed = np.concatenate([part[2] for part in parts]), np.concatenate([part[3] for part in parts])
    linked = np.concatenate([np.where(part[4] >= 0, part[4] + start, -1) for part, start in zip(parts, starts)])
    x0, y0, x1, y1 = area
    inside = (xy[:, 0] >= x0) & (xy[:, 0] < x1) & (xy[:, 1] >= y0) & (xy[:, 1] < y1)
    own = np.flatnonzero(inside)
    row = np.full(len(xy) + 1, -1)
    row[own] = np.arange(len(own))
    linked = linked[own]
    leaves = (linked >= 0) & (row[linked] < 0)
    outside = np.full((*linked.shape, 2), np.nan)
    outside[leaves] = xy[linked[leaves]]
    ground = near.take_area(area, 0.0)
    return LinkedStations(
        StationTable(
            xy[own],
            tangent[own],
            near.line_evidence.take(rows[own]),
            ground.ring_offsets,
            ground.ring_xy,
            ground.ring_evidence,
            ground.observed_cells,
        ),
        is_observed[own],
        row[linked],
        outside,
    )


def _link_rows(
    table: StationTable, rows: Ints, config: LinkConfig, extension: ParallelExtensionConfig
) -> tuple[Floats, Floats, Ints, Flags, Ints]:
    """Link the chosen stations: positions, tangents, rows of the table with the evidence, whether each was observed, and links."""
    line = table.line_evidence

    def link(xy: Floats, tangent: Floats, rows: Ints) -> Ints:
        dashed = line.style[rows].argmax(1) == DASHED
        return find_links(xy, tangent, line.kind[rows], line.log_odds[rows], dashed, line.coverage[rows], config)

    xy, tangent, count = table.xy[rows], table.tangent[rows], len(rows)
    pair = link(xy, tangent, rows)
    chains = trace_chains(pair, line.log_odds[rows])
    added, turned, source = extend_parallel(xy, line.kind[rows], line.coverage[rows], chains, extension)
    if len(added):
        xy, tangent = np.concatenate((xy, added)), np.concatenate((tangent, turned))
        rows = np.concatenate((rows, rows[source]))
        pair = link(xy, tangent, rows)
    return xy, tangent, rows, np.arange(len(xy)) < count, pair


def stitch_blocks(blocks: Sequence[LinkedStations]) -> LinkedStations:
    """Merge blocks, in any order: a link between two of them stays where both have it.

    ``outside`` names the stations of other blocks that could not be linked, for instance since their block is not among these.
    """
    xy = np.concatenate([b.table.xy for b in blocks])
    evidence = EvidenceTable.cat([b.table.line_evidence for b in blocks])
    is_observed = np.concatenate([b.is_observed for b in blocks])
    starts = np.cumsum([0, *(len(b.table) for b in blocks)])
    linked = np.concatenate([np.where(b.linked >= 0, b.linked + start, -1) for b, start in zip(blocks, starts)])
    outside = np.concatenate([b.outside for b in blocks])
    linked = _join_borders(xy, evidence, linked, outside)
    outside = np.where((linked >= 0)[..., None], np.nan, outside)
    # Rings and ground merge as those of areas do.
    table = StationTable.cat([b.table for b in blocks])
    order = np.lexsort((xy[:, 1], xy[:, 0], evidence.kind, ~is_observed))
    place = np.full(len(xy) + 1, -1)
    place[order] = np.arange(len(order))
    tangent = np.concatenate([b.table.tangent for b in blocks])
    merged = StationTable(
        xy[order],
        tangent[order],
        evidence.take(order),
        table.ring_offsets,
        table.ring_xy,
        table.ring_evidence,
        table.observed_cells,
    )
    return LinkedStations(merged, is_observed[order], place[linked[order]], outside[order])


def _join_borders(xy: Floats, evidence: EvidenceTable, linked: Ints, outside: Floats) -> Ints:
    """Return links (K, 2) with those to stations of other blocks that link back."""
    linked = linked.copy()
    station, side = np.nonzero(~np.isnan(outside[..., 0]))
    is_retired = evidence.state == RETIRED
    keys = [(int(evidence.kind[k]), bool(is_retired[k]), *xy[k].tolist()) for k in station.tolist()]
    rows = dict(zip(keys, station.tolist()))
    for key, k, s in zip(keys, station.tolist(), side.tolist()):
        other = rows.get((*key[:2], *outside[k, s].tolist()))
        if other is not None and (outside[other] == xy[k]).all(1).any():
            linked[k, s] = other
    return linked
