# SPDX-License-Identifier: Apache-2.0
"""Assemble a map region by region from linked stations, with the same elements as in one piece.

A region is a square of tiles. Its elements are those whose canonical start lies in it. A worker loads the linked stations of the
blocks around the region, and of further blocks as long as a line that may start in the region leaves those that it has: so no line
is cut, and no worker needs more than such lines reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.fusion.block_linking import LinkedStations, list_blocks, stitch_blocks
from manyeyes.maps.fusion.fuse import MapFusionConfig, assemble_elements
from manyeyes.maps.fusion.polyline_linking import LinkConfig
from manyeyes.maps.fusion.stations import Area
from manyeyes.maps.store.map_diff import compute_home_tiles
from manyeyes.maps.store.observation_log import TILE_M

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Place = tuple[int, int]
Bounds = tuple[float, float, float, float]
"""Least x and y, largest x and y, metres."""

REGION_TILES = 4
"""Tiles along the side of a region."""
LINE_REACH_M = 16.0
"""Stations move by less than this when lines are smoothed."""
RING_REACH_M = 64.0
"""A crossing is shorter than this."""
NOWHERE: Bounds = (np.inf, np.inf, -np.inf, -np.inf)


@dataclass(frozen=True, eq=False)
class RegionMap:
    """The elements of a region, by canonical order, with ids by content and without relations."""

    elements: VectorMap

    @property
    def bounds(self) -> Bounds:
        """The box of all elements; NOWHERE without any."""
        return find_bounds(self.elements)


def find_region(tiles: Ints) -> Ints:
    """Return (N, 2) the regions of tiles (N, 2)."""
    return np.floor_divide(tiles, REGION_TILES)


def find_region_area(region: Place) -> Area:
    """Return the area (x0, y0, x1, y1; metres) of a region."""
    side = REGION_TILES * TILE_M
    return region[0] * side, region[1] * side, (region[0] + 1) * side, (region[1] + 1) * side


def list_regions(areas: list[Area]) -> list[Place]:
    """List the regions in which elements of stations in areas may start, ascending."""
    side, found = REGION_TILES * TILE_M, set[Place]()
    for area in areas:
        x0, y0, x1, y1 = widen(area, RING_REACH_M)
        found.update(
            (i, j)
            for i in range(int(x0 // side), int(x1 // side) + 1)
            for j in range(int(y0 // side), int(y1 // side) + 1)
        )
    return sorted(found)


def assemble_region(
    region: Place,
    load: Callable[[Place], LinkedStations | None],
    config: MapFusionConfig,
    frame: MapFrame,
) -> RegionMap:
    """Assemble the elements that start in a region; load: returns the linked stations of a block, None of none."""
    area, blocks = find_region_area(region), dict[Place, LinkedStations | None]()
    missing = set(list_blocks([widen(area, RING_REACH_M)], config.link))
    stations, rows = None, np.zeros(0, np.int64)
    while missing:
        blocks |= {block: load(block) for block in sorted(missing)}
        parts = [part for part in blocks.values() if part is not None]
        if not parts:
            return RegionMap(VectorMap.empty(frame))
        stations = stitch_blocks(parts)
        rows = _find_lines_near(stations, widen(area, LINE_REACH_M))
        missing = _find_blocks(stations, rows, config.link) - blocks.keys()
    assert stations is not None
    whole = assemble_elements(stations.take(rows), config, frame)
    return RegionMap(whole.take((find_region(compute_home_tiles(whole)) == region).all(1)))


def _find_lines_near(stations: LinkedStations, area: Area) -> Ints:
    """Return the rows of all stations of lines with a station in an area, ascending."""
    xy, linked = stations.table.xy, stations.linked
    station, side = np.nonzero(linked >= 0)
    links = coo_array((np.ones(len(station), np.int8), (station, linked[station, side])), shape=(len(xy), len(xy)))
    label = connected_components(links, directed=False)[1]
    inside = (xy[:, 0] >= area[0]) & (xy[:, 0] < area[2]) & (xy[:, 1] >= area[1]) & (xy[:, 1] < area[3])
    return np.flatnonzero(np.isin(label, label[inside]))


def _find_blocks(stations: LinkedStations, rows: Ints, config: LinkConfig) -> set[Place]:
    """Return the blocks near the chosen stations, whose ground matters, and those of the stations to which they lead."""
    xy, outside = stations.table.xy[rows], stations.outside[rows].reshape(-1, 2)
    corners = [xy + (dx, dy) for dx in (-LINE_REACH_M, LINE_REACH_M) for dy in (-LINE_REACH_M, LINE_REACH_M)]
    places = np.concatenate([*corners, outside[~np.isnan(outside[:, 0])]])
    found = np.unique(np.floor(places / config.block_m + 0.5).astype(np.int64), axis=0)
    return {(int(x), int(y)) for x, y in found}


def find_bounds(vector_map: VectorMap) -> Bounds:
    """Return the box of all elements; NOWHERE without any."""
    if not len(vector_map):
        return NOWHERE
    box = vector_map.elements.bounds()
    return float(box[:, 0].min()), float(box[:, 1].min()), float(box[:, 2].max()), float(box[:, 3].max())


def widen(area: Bounds, margin_m: float) -> Bounds:
    """Return a box with a margin."""
    return area[0] - margin_m, area[1] - margin_m, area[2] + margin_m, area[3] + margin_m


def unite(*boxes: Bounds) -> Bounds:
    """Return the box of boxes."""
    sides = list(zip(*boxes))
    return (min(sides[0]), min(sides[1]), max(sides[2]), max(sides[3])) if boxes else NOWHERE


def touches(one: Bounds, other: Bounds) -> bool:
    """Return whether two boxes have a common point."""
    return one[0] <= other[2] and other[0] <= one[2] and one[1] <= other[3] and other[1] <= one[3]


def take_near(vector_map: VectorMap, box: Bounds) -> VectorMap:
    """Return the elements whose boxes touch a box."""
    if not len(vector_map):
        return vector_map
    bounds = vector_map.elements.bounds()
    near = (bounds[:, 0] <= box[2]) & (box[0] <= bounds[:, 2]) & (bounds[:, 1] <= box[3]) & (box[1] <= bounds[:, 3])
    return vector_map.take(near)
