# SPDX-License-Identifier: Apache-2.0
"""Tiles of a drive: where they lie, who looked at them and when, and what is truly there.

A tile is judged against all that the true map has within it, seen or not: what one vehicle cannot see is what others are for.
Training leaves out what no look could have met (``met_by``), else a model learns to invent. Lines are cut at the tile's border,
rings too, and stay rings; parts of lines below 2 m and of rings below 3 m² are no elements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.mapping import DEFAULT_BUDGET, draw_tile, receive, share_look
from manyeyes.comms.wire import Precision
from manyeyes.datasets.recording import Recording
from manyeyes.datatypes import AgentFrame, BevGrid, ConfigError, MissingExtraError, Transform
from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.evaluation.map_quality import MapQuality, judge
from manyeyes.evaluation.observed import SHORTEST_PART_M, with_geometry
from manyeyes.models.mapper import LOOKS, Mapper

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]

LEAST_RING_M2 = 3.0
APART_M = 1000.0
MET_SHARE = 0.3
"""Of an element's length: what looks must have covered for it to be asked of them (specs: maps.md 1.5)."""


@dataclass(frozen=True)
class Tile:
    """A tile of one scenario's town. world_from_tile: upright, float64. looks: who looked, in the order in which they are taken.

    truth: in the tile's frame, cut to it.
    """

    scenario: str
    world_from_tile: Transform
    looks: tuple[AgentFrame, ...]
    truth: MapElements


def town_of(scenario: str, towns: Sequence[str]) -> str:
    """The town that a scenario is named after: ``town05_0066`` was driven in Town05."""
    for town in sorted(towns, key=len, reverse=True):
        if scenario.lower().startswith(town.lower()):
            return town
    raise ConfigError(
        f"Scenario {scenario!r} is named after none of the towns {', '.join(towns)}; give the map of its town."
    )


def assert_split(taught: Sequence[str], judged: Sequence[str]) -> None:
    """ConfigError where a town is on both sides: the map of a town is one sample, however many frames were driven there."""
    shared = sorted({town.lower() for town in taught} & {town.lower() for town in judged})
    if shared:
        raise ConfigError(f"Split by place: {', '.join(shared)} may not both teach and judge; leave one side out.")


def cut_to(truth: MapElements, world_from_tile: Transform, tile: BevGrid) -> MapElements:
    """What of the elements (world) lies in the tile, in the tile's frame."""
    shapely = _shapely()
    x, y, yaw = _planar(world_from_tile.inverse())
    local = truth.transform(x, y, yaw)
    box = shapely.box(tile.x_min, tile.y_min, tile.x_max, tile.y_max)
    rows: list[int] = []
    parts: list[Floats] = []
    for row in range(len(local)):
        points = local.polyline(row)
        if (points.max(0) < [tile.x_min, tile.y_min]).any() or (points.min(0) > [tile.x_max, tile.y_max]).any():
            continue
        for part in _inside(points, bool(local.kind[row] == CROSSING), box):
            rows.append(row)
            parts.append(part)
    return with_geometry(local, rows, parts)


def met_by(elements: MapElements, tile_from_look: Sequence[Transform], view: BevGrid) -> MapElements:
    """Those elements of a tile that the looks together cover by MET_SHARE of their length; a look covers its grid's rectangle."""
    shapely = _shapely()
    corners = np.array(
        [[view.x_min, view.y_min], [view.x_max, view.y_min], [view.x_max, view.y_max], [view.x_min, view.y_max]]
    )
    placed = []
    for motion in tile_from_look:
        x, y, yaw = _planar(motion)
        c, s = np.cos(yaw), np.sin(yaw)
        placed.append(shapely.polygons(corners @ np.array([[c, s], [-s, c]]) + [x, y]))
    area = shapely.union_all(placed)
    kept = np.zeros(len(elements), bool)
    for row in range(len(elements)):
        line = shapely.linestrings(elements.polyline(row))
        kept[row] = shapely.length(shapely.intersection(line, area)) >= MET_SHARE * shapely.length(line)
    return elements.take(kept)


def tiles_of(
    recording: Recording, maps: Mapping[str, MapElements], tile: BevGrid, looks: int = LOOKS, every: int = 1
) -> list[Tile]:
    """One tile a scenario (or every n-th): about its first agent, along that agent's heading, at its first judged frame.

    maps: the truth of each town, in its world frame. The first look is that agent's, then come those of the others in order,
    then all agents again at later frames, so that a smaller number of looks takes the first of them.
    """
    found = []
    for scenario in recording.scenarios[::every]:
        judged = recording.judged(scenario)
        snapshot = recording.snapshot(scenario, judged[0])
        own = snapshot.frames[0]
        x, y, yaw = _planar(own.world_from_agent)
        world_from_tile = Transform.from_xyz_yaw(x, y, 0.0, yaw)
        frames = list(snapshot.frames)
        # Instants as far apart as there are: a second look from the same place adds little.
        steps = max(1, -(-looks // len(frames)))
        for index in np.unique(np.linspace(judged[0], judged[-1], steps + 1).round().astype(int)).tolist()[1:]:
            frames += recording.snapshot(scenario, index).frames
        truth = cut_to(maps[town_of(scenario, tuple(maps))], world_from_tile, tile)
        found.append(Tile(scenario, world_from_tile, tuple(frames[:looks]), truth))
    return found


@dataclass(frozen=True)
class TileScore:
    """What a map model drew on a set of tiles from at most ``looks`` looks each.

    quality: of all tiles together, predictions ranked as one list. bytes_per_look: mean over messages that said anything.
    """

    looks: int
    quality: MapQuality
    kinds: tuple[str, ...]
    messages: int
    bytes_per_look: float

    def mean_ap(self, way: str = "maptr") -> float:
        """mAP over those of the model's kinds that have truth."""
        return self.quality.mean_ap(way, kinds=self.kinds)


def judge_tiles(
    mapper: Mapper,
    tiles: Sequence[Tile],
    looks: int = LOOKS,
    precision: Precision = "int8",
    budget_bytes: int | None = DEFAULT_BUDGET,
    ways: Sequence[str] = ("maptr", "exact"),
) -> TileScore:
    """Draw every tile from its first looks, each shared as packets and received again, and judge all as one set."""
    drawn, truth, sizes = [], [], []
    for tile in tiles:
        packets = [share_look(mapper, frame, precision, budget_bytes) for frame in tile.looks[:looks]]
        sizes += [sum(map(len, one)) for one in packets if one]
        messages = [message for one in packets if (message := receive(one, mapper)) is not None]
        drawn.append(draw_tile(mapper, messages, tile.world_from_tile))
        truth.append(tile.truth)
    kinds = mapper.config.head.kinds
    quality = judge(side_by_side(drawn), side_by_side(truth), ways, kinds)
    return TileScore(looks, quality, kinds, len(sizes), sum(sizes) / max(1, len(sizes)))


def side_by_side(maps: Sequence[MapElements]) -> MapElements:
    """Maps of many tiles in one frame, so far apart that none is near another: so one list is ranked over all of them."""
    return MapElements.cat([elements.transform(APART_M * i, 0.0, 0.0) for i, elements in enumerate(maps)])


def _inside(points: Floats, ring: bool, box: BaseGeometry) -> list[Floats]:
    shapely = _shapely()
    if ring:
        shape = shapely.make_valid(shapely.polygons(points))
        found = shapely.get_parts(shapely.intersection(shape, box))
        polygons = [p for p in found if p.geom_type == "Polygon" and p.area >= LEAST_RING_M2]
        return [shapely.get_coordinates(p.exterior)[:-1] for p in polygons]
    found = shapely.get_parts(shapely.line_merge(shapely.intersection(shapely.linestrings(points), box)))
    return [shapely.get_coordinates(p) for p in found if p.geom_type == "LineString" and p.length >= SHORTEST_PART_M]


def _planar(motion: Transform) -> tuple[float, float, float]:
    x, y, _ = motion.translation.tolist()
    return x, y, float(motion.yaw)


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise MissingExtraError("map", "cutting the true map to tiles") from error
    return shapely
