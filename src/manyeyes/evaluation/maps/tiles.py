# SPDX-License-Identifier: Apache-2.0
"""Tiles of a drive: their places, the frames that observe them, and their ground truth.

A tile is evaluated against all elements of the true map within it, observed or not, since collaboration is to recover what one
vehicle cannot see. Training leaves out elements that no frame observed (training.maps.targets), to avoid false positives. Lines are
cut at the tile's border, rings too, and stay rings; parts of lines below 2 m and of rings below 3 m² are no elements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import AgentFrame, BevGrid, ConfigError, Transform
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.maps.observed_area import MIN_PART_LENGTH_M, replace_geometry

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "cutting the true map to tiles")

Floats = NDArray[np.float64]

MIN_RING_AREA_M2 = 3.0
MAP_SPACING_M = 1000.0


@dataclass(frozen=True)
class Tile:
    """A tile of one scenario's town. world_from_tile: upright, float64. frames: the observing frames, in the order of use.

    truth: in the tile's frame, cut to it.
    """

    scenario: str
    world_from_tile: Transform
    frames: tuple[AgentFrame, ...]
    truth: MapElements


def find_town(scenario: str, towns: Sequence[str]) -> str:
    """Return the town that a scenario is named after: ``town05_0066`` was driven in Town05."""
    for town in sorted(towns, key=len, reverse=True):
        if scenario.lower().startswith(town.lower()):
            return town
    raise ConfigError(
        f"Scenario {scenario!r} is named after none of the towns {', '.join(towns)}; give the map of its town."
    )


def check_town_split(training_towns: Sequence[str], evaluation_towns: Sequence[str]) -> None:
    """ConfigError where a town is on both sides: the map of a town is one sample, however many frames were driven there."""
    shared = sorted({town.lower() for town in training_towns} & {town.lower() for town in evaluation_towns})
    if shared:
        raise ConfigError(f"Split by place: {', '.join(shared)} may not both teach and judge; leave one side out.")


def crop_to_tile(truth: MapElements, world_from_tile: Transform, tile: BevGrid) -> MapElements:
    """What of the elements (world) lies in the tile, in the tile's frame."""
    shapely = _shapely()
    x, y, yaw = to_xy_yaw(world_from_tile.inverse())
    local = truth.transform(x, y, yaw)
    box = shapely.box(tile.x_min, tile.y_min, tile.x_max, tile.y_max)
    rows: list[int] = []
    parts: list[Floats] = []
    for row in range(len(local)):
        points = local.polyline(row)
        if (points.max(0) < [tile.x_min, tile.y_min]).any() or (points.min(0) > [tile.x_max, tile.y_max]).any():
            continue
        for part in _clip_to_box(points, bool(local.kind[row] == CROSSING), box):
            rows.append(row)
            parts.append(part)
    return replace_geometry(local, rows, parts)


def place_side_by_side(maps: Sequence[MapElements]) -> MapElements:
    """Return maps of many tiles in one frame, so far apart that none is near another: so one list is ranked over all of them."""
    return MapElements.cat([elements.transform(MAP_SPACING_M * i, 0.0, 0.0) for i, elements in enumerate(maps)])


def _clip_to_box(points: Floats, ring: bool, box: BaseGeometry) -> list[Floats]:
    shapely = _shapely()
    if ring:
        shape = shapely.make_valid(shapely.polygons(points))
        found = shapely.get_parts(shapely.intersection(shape, box))
        polygons = [p for p in found if p.geom_type == "Polygon" and p.area >= MIN_RING_AREA_M2]
        return [shapely.get_coordinates(p.exterior)[:-1] for p in polygons]
    found = shapely.get_parts(shapely.line_merge(shapely.intersection(shapely.linestrings(points), box)))
    return [shapely.get_coordinates(p) for p in found if p.geom_type == "LineString" and p.length >= MIN_PART_LENGTH_M]


def to_xy_yaw(transform: Transform) -> tuple[float, float, float]:
    """x, y and yaw of a motion."""
    x, y, _ = transform.translation.tolist()
    return x, y, float(transform.yaw)
