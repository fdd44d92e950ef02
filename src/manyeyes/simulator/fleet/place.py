# SPDX-License-Identifier: Apache-2.0
"""Places to simulate: a true map, lanes, the ground of junctions and an evaluated area, in one local metric frame."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, MapElements
from manyeyes.maps.elements.observation import MapFrame
from manyeyes.maps.formats.argoverse2_map import read_argoverse2_map, read_argoverse2_poses
from manyeyes.maps.formats.lanelet2 import lanelet2_origin, read_lanelet2
from manyeyes.maps.formats.v2x_seq_map import read_v2x_seq_map
from manyeyes.maps.roads.ground_truth import GroundTruthPolicy, build_ground_truth_map, compute_junction_region
from manyeyes.maps.roads.road_network import RoadNetwork
from manyeyes.maps.roads.transverse_mercator import degrees_from_metres
from manyeyes.simulator.fleet.generated_roads import HALF_SIZE_M, make_merge, make_roundabout, road_truth
from manyeyes.simulator.fleet.generated_streets import StreetPlan, street_junctions, street_routes, street_truth
from manyeyes.simulator.fleet.routes import Routes
from manyeyes.simulator.scene.roads import crossing_sites
from manyeyes.simulator.scene.towns import GENERATED, TOWNS, load_town

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "A place to map")

Array = NDArray[np.float64]

AV2_LOGS = {
    "av2-miami": "3b3570b4-7b0b-3268-a571-b0889dbf40b6",
    "av2-pittsburgh": "7fab2350-7eaf-3b7e-a39d-6937a4c1bede",
}
# Latitude and longitude of Argoverse 2's city frames (av2-api's documentation); a city frame is UTM's, moved. Taken here as a
# transverse Mercator of scale 1, it is off by the convergence of meridians (below 1°) and 0.4 m a kilometre from the origin:
# good enough to lie on the right street of a web map, no survey.
_CITY_ORIGIN = {
    "ATX": (30.27464237939507, -97.7404457407424),
    "DTW": (42.29993066912924, -83.17555750783717),
    "MIA": (25.77452579915163, -80.19656914449405),
    "PAO": (37.416065, -122.13571963362166),
    "PIT": (40.44177902989321, -80.01294377242584),
    "WDC": (38.889377, -77.0355047439081),
}
# CARLA's towns are nowhere; its own default reference.
_CARLA_ORIGIN = (49.0, 8.0)
_PLANS = {
    "cross": StreetPlan(lanes=3),
    "grid": StreetPlan(columns=4, rows=4, arm_m=90.0, lanes=2, warp_m=4.0, turn_rad=0.3),
}
_LAYOUTS = {"roundabout": make_roundabout, "merge": make_merge}
PLACES = (*TOWNS, *AV2_LOGS, "lanelet2", *_PLANS, *_LAYOUTS)
MAX_GRID = 100
"""Maximum crossroads a side of a generated lattice."""


@dataclass(frozen=True, eq=False)
class Place:
    """A place in its local frame: metres, x east, y north, zero in the middle of the area.

    truth: every true element of the place, also beyond the area. routes: lanes that vehicles drive on. junctions: the ground of
    junctions, where lines are cut (``maps.roads.ground_truth.cut_elements`` cuts any map there). area: x_min, y_min, x_max, y_max
    that is driven and evaluated. logs: recorded drives, poses (N, 3) each. world_xy: the local zero in the source's own frame.
    """

    name: str
    truth: MapElements
    routes: Routes
    junctions: BaseGeometry
    area: tuple[float, float, float, float]
    frame: MapFrame
    logs: tuple[Array, ...] = ()
    world_xy: tuple[float, float] = (0.0, 0.0)

    def clip_to_area(self, elements: MapElements | None = None, min_line_m: float = 5.0) -> MapElements:
        """Return elements (the truth unless others are given) cut to the area, by :func:`clip_to_box`."""
        return clip_to_box(self.truth if elements is None else elements, self.area, min_line_m)


def load_place(name: str, size_m: float | None = 300.0, data: Path | str | None = None) -> Place:
    """Return a place by name: a CARLA town, ``generated-<seed>``, av2-miami, av2-pittsburgh, lanelet2, cross, grid,
    ``grid-<n>``, roundabout or merge.

    size_m: side of the square area; in towns it lies about the largest junction, None takes all of the place. Real logs and
    generated streets are never larger than they are. data: the folder with ``carla_opendrive``, ``av2`` and ``lanelet2``; where
    none is given, the folder ``data`` in a folder ``shared`` beside the repository or above the working directory.
    """
    return _load_place(name, size_m, None if data is None else str(data))


def check_place(name: str) -> None:
    """Raise ConfigError where a name is not that of a place; reads no file."""
    if name.startswith("grid-"):
        count = name.removeprefix("grid-")
        if not count.isdecimal() or len(count) > 3 or not 1 <= int(count) <= MAX_GRID:
            raise ConfigError(
                f"A generated lattice is named grid-<n> with 1 to {MAX_GRID} crossroads a side; got '{name}'."
            )
    elif name not in PLACES and not name.startswith(GENERATED):
        raise ConfigError(f"Unknown place '{name}'; known: {', '.join(PLACES)}, grid-<n>, {GENERATED}<seed>.")


@lru_cache(maxsize=16)
def _load_place(name: str, size_m: float | None, data: str | None) -> Place:
    check_place(name)
    if name in _PLANS or name.startswith("grid-"):
        return _generate_place(name, size_m)
    if name in _LAYOUTS:
        return _lay_out_place(name, size_m)
    if name in TOWNS or name.startswith(GENERATED):
        folder = None if data is None or name.startswith(GENERATED) else Path(data) / "carla_opendrive"
        network = load_town(name, folder)
        return make_place(network, name, GroundTruthPolicy(boundary="pavement"), size_m, _CARLA_ORIGIN)
    if name in AV2_LOGS:
        log = _data(data) / "av2" / AV2_LOGS[name]
        city = next(iter(sorted(log.glob("map/log_map_archive_*.json"))), Path("____MIA")).name
        origin = next((o for c, o in _CITY_ORIGIN.items() if f"____{c}_" in city), (0.0, 0.0))
        found = make_place(read_argoverse2_map(log), name, GroundTruthPolicy(), size_m, origin)
        _, poses = read_argoverse2_poses(log)
        return replace(found, logs=(poses - [*found.world_xy, 0.0],))
    path = _data(data) / "lanelet2" / "mapping_example.osm"
    return make_place(read_lanelet2(path), name, GroundTruthPolicy(), size_m, lanelet2_origin(path))


@lru_cache(maxsize=4)
def load_place_from_map(path: Path) -> Place:
    """Return a place out of a file of a real map: an intersection of V2X-Seq, a map (or log) of Argoverse 2, or Lanelet2's
    .osm.
    """
    origin = (0.0, 0.0)
    if path.suffix == ".osm":
        network, origin = read_lanelet2(path), lanelet2_origin(path)
    elif path.is_dir() or path.name.startswith("log_map_archive_"):
        network = read_argoverse2_map(path)
    else:
        network = read_v2x_seq_map(path)
    return make_place(network, path.stem, GroundTruthPolicy(), None, origin)


def make_place(
    network: RoadNetwork, name: str, policy: GroundTruthPolicy, size_m: float | None, origin: tuple[float, float]
) -> Place:
    """Return a place out of any road network; origin: latitude and longitude of the network's zero, degrees."""
    x0, y0, x1, y1 = network.bounds
    middle = np.round([(x0 + x1) / 2, (y0 + y1) / 2])
    half = np.array([x1 - x0, y1 - y0]) / 2
    if size_m is not None and 2 * half.max() > 1.2 * size_m:
        sites = crossing_sites(network) or crossing_sites(network, single_level=False)
        middle = np.round(sites[0].center[:2]) if sites else middle
        half = np.full(2, size_m / 2)
    truth = build_ground_truth_map(network, policy).transform(-middle[0], -middle[1], 0.0)
    routes = Routes.of_network(network, middle).within(-half, half)
    ground = _shift(compute_junction_region(network, policy.junction_margin_m), middle)
    latitude, longitude = degrees_from_metres(middle, origin).tolist()
    area = (-float(half[0]), -float(half[1]), float(half[0]), float(half[1]))
    return Place(
        name, truth, routes, ground, area, MapFrame(latitude, longitude), world_xy=(float(middle[0]), float(middle[1]))
    )


def clip_to_box(elements: MapElements, box: tuple[float, float, float, float], min_line_m: float = 0.0) -> MapElements:
    """Return lines cut to a box x_min, y_min, x_max, y_max; crossings and stop lines stay whole when their middle lies inside."""
    shapely = _shapely()
    parts, kinds, scores, sigmas, styles = [], [], [], [], []
    for k in range(len(elements)):
        points = elements.polyline(k)
        if elements.kind[k] >= CROSSING:
            x, y = points.mean(0)
            pieces = [points] if box[0] <= x <= box[2] and box[1] <= y <= box[3] else []
        else:
            cut = shapely.clip_by_rect(shapely.LineString(points), *box)
            pieces = [shapely.get_coordinates(part) for part in shapely.get_parts(cut) if part.length >= min_line_m]
        for piece in pieces:
            parts.append(piece)
            kinds.append(elements.kind[k])
            scores.append(elements.score[k])
            styles.append(elements.style[k])
            sigmas.append(np.full(len(piece), elements.sigma[elements.offsets[k] : elements.offsets[k + 1]].mean()))
    if not parts:
        return MapElements.empty()
    return MapElements.of(parts, kinds, scores, np.concatenate(sigmas), np.array(styles))


def _generate_place(name: str, size_m: float | None) -> Place:
    """Return a lattice of streets; ``grid-<n>`` has n × n crossroads."""
    shapely = _shapely()
    plan = _PLANS.get(name)
    if plan is None:
        count = int(name.removeprefix("grid-"))
        plan = replace(_PLANS["grid"], columns=count, rows=count)
    truth, routes = street_truth(plan), street_routes(plan)
    half = np.abs(routes.points).max(0) + 5.0
    if size_m is not None:
        half = np.minimum(half, size_m / 2)
    ground = shapely.union_all([shapely.Polygon(ring) for ring in street_junctions(plan)])
    area = (-float(half[0]), -float(half[1]), float(half[0]), float(half[1]))
    return Place(name, truth, routes.within(-half, half), ground, area, MapFrame(*_CARLA_ORIGIN))


def _lay_out_place(name: str, size_m: float | None) -> Place:
    """Return a place of roads that are no lattice."""
    layout = _LAYOUTS[name]()
    half = np.full(2, HALF_SIZE_M if size_m is None else min(HALF_SIZE_M, size_m / 2))
    area = (-float(half[0]), -float(half[1]), float(half[0]), float(half[1]))
    routes = layout.routes.within(-half, half)
    return Place(name, road_truth(layout), routes, layout.ground, area, MapFrame(*_CARLA_ORIGIN))


def _shift(ground: BaseGeometry, origin: Array) -> BaseGeometry:
    shapely = _shapely()
    return shapely.transform(ground, lambda points: points - origin)


def _data(data: str | None) -> Path:
    """Return the folder of real maps."""
    if data is not None:
        return Path(data)
    if os.environ.get("MANYEYES_MAPS"):
        return Path(os.environ["MANYEYES_MAPS"])
    raise ConfigError(
        "The real maps are not here: give data= or set MANYEYES_MAPS, a folder with 'av2' and 'lanelet2'; 'grid' needs no file."
    )
