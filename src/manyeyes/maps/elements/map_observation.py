# SPDX-License-Identifier: Apache-2.0
"""A whole map as observations, so that maps of several sources are fused like the drives of several agents.

The ground that a map covers is what lies within ``margin_m`` of its elements, gaps up to twice that included. Each connected
piece of it is one observation of the map's agent, all of one drive: misses count there and nowhere else. A map that is larger
than an observation may be (``observation_limits.LIMITS``) is halved until its parts are not; lines are cut there, crossings
belong to the part that holds their middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, MapElements, Polygons
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.observation_limits import LIMITS

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_shapely = partial(import_extra, "shapely", "map", "Maps as observations")

Floats = NDArray[np.float64]
Box = tuple[float, float, float, float]

_MAX_SIDE_M = 1.8 * LIMITS.max_reach_m
_MIN_SIDE_M = 20.0
_MIN_PART_M = 0.5
_MIN_HOLE_M2 = 25.0


@dataclass(frozen=True)
class MapSource:
    """Who made a map, when, and how exact it is.

    sigma_m, sigma_yaw_rad: standard deviation of its position and heading as a whole. score, point_sigma_m: of every element,
    instead of its own. trusted: a surveyed map, whose one word publishes an element. margin_m: ground beside its elements.
    """

    agent: str
    time_ns: int = 0
    sigma_m: float = 0.5
    sigma_yaw_rad: float = math.radians(0.1)
    score: float | None = None
    point_sigma_m: float | None = None
    trusted: bool = False
    margin_m: float = 10.0


def make_map_observations(elements: MapElements, source: MapSource) -> list[Observation]:
    """Return a map's elements (in the map's frame, metres) as observations of one drive, from west to east."""
    if not len(elements):
        return []
    x0, y0 = elements.points.min(0) - source.margin_m
    x1, y1 = elements.points.max(0) + source.margin_m
    box = (math.floor(x0), math.floor(y0), math.ceil(x1), math.ceil(y1))
    return [made for part, area in _split(elements, box) for made in _observe(part, area, source)]


def _split(elements: MapElements, box: Box) -> Iterator[tuple[MapElements, Box]]:
    """Yield parts of a map that each fit into one observation, and their boxes."""
    x0, y0, x1, y1 = box
    width, height = x1 - x0, y1 - y0
    fits = max(width, height) <= _MAX_SIDE_M and len(elements) <= LIMITS.max_elements
    fits = fits and len(elements.points) <= LIMITS.max_points and elements.lengths().sum() <= LIMITS.max_length_m
    if fits or (width <= _MIN_SIDE_M and height <= _MIN_SIDE_M):
        yield elements, box
        return
    middle = (x0 + x1) / 2 if width >= height else (y0 + y1) / 2
    halves = (
        ((x0, y0, middle, y1), (middle, y0, x1, y1))
        if width >= height
        else ((x0, y0, x1, middle), (x0, middle, x1, y1))
    )
    for half in halves:
        part = _clip(elements, half)
        if len(part):
            yield from _split(part, half)


def _clip(elements: MapElements, box: Box) -> MapElements:
    """Return the parts of lines inside a box, and the crossings whose middle is inside."""
    shapely = _shapely()
    x0, y0, x1, y1 = box
    area = shapely.box(*box)
    rows, lines, sigma = [], [], []
    for row in range(len(elements)):
        points = elements.polyline(row)
        own_sigma = elements.sigma[elements.offsets[row] : elements.offsets[row + 1]]
        inside = ((points >= (x0, y0)) & (points < (x1, y1))).all(1)
        x, y = points.mean(0)
        if inside.all() or (elements.kind[row] == CROSSING and x0 <= x < x1 and y0 <= y < y1):
            parts = [points]
        elif elements.kind[row] == CROSSING:
            parts = []
        else:
            cut = shapely.line_merge(shapely.intersection(shapely.linestrings(points), area))
            parts = [shapely.get_coordinates(p) for p in shapely.get_parts(cut) if p.length >= _MIN_PART_M]
        for part in parts:
            rows.append(row)
            lines.append(part)
            sigma.append(own_sigma if len(part) == len(points) else np.full(len(part), own_sigma.mean()))
    index = np.array(rows, np.int64)
    flat = np.concatenate(sigma) if sigma else np.zeros(0)
    return MapElements.of(lines, elements.kind[index], elements.score[index], flat, elements.style[index])


def compute_covered_ground(elements: MapElements, margin_m: float) -> BaseGeometry:
    """Return the ground within margin_m of elements, gaps up to twice that included (shapely geometry, their frame)."""
    shapely = _shapely()
    shapes = [
        shapely.Polygon(elements.polyline(k)) if elements.closed[k] else shapely.LineString(elements.polyline(k))
        for k in range(len(elements))
    ]
    wide = shapely.union_all(shapely.buffer(shapely.simplify(shapes, 0.2), 2 * margin_m, quad_segs=4))
    return shapely.simplify(shapely.buffer(wide, -margin_m, quad_segs=4), 0.5)


def _observe(elements: MapElements, box: Box, source: MapSource) -> Iterator[Observation]:
    """Yield one observation for each connected piece of the ground that a part of the map covers."""
    shapely = _shapely()
    ground = shapely.intersection(compute_covered_ground(elements, source.margin_m), shapely.box(*box))
    pieces = [p for p in shapely.get_parts(ground) if p.geom_type == "Polygon"]
    middle = np.array([elements.polyline(k)[len(elements.polyline(k)) // 2] for k in range(len(elements))])
    distance = np.stack([shapely.distance(shapely.points(middle), piece) for piece in pieces])
    owner = distance.argmin(0)
    for number, piece in enumerate(pieces):
        own = np.flatnonzero(owner == number)
        if len(own):
            yield _make_observation(elements.take(own), piece, source)


def _make_observation(elements: MapElements, piece: BaseGeometry, source: MapSource) -> Observation:
    bounds = np.array(piece.bounds)
    origin = np.round((bounds[:2] + bounds[2:]) / 2, 1)
    local = elements.with_points(elements.points - origin)
    if source.score is not None or source.point_sigma_m is not None:
        local = MapElements(
            local.kind,
            local.offsets,
            local.points,
            local.score if source.score is None else np.full(len(local), source.score),
            local.sigma if source.point_sigma_m is None else np.full(len(local.points), source.point_sigma_m),
            local.style,
        )
    view, holes = _to_rings(piece)
    variance = [source.sigma_m**2, source.sigma_m**2, source.sigma_yaw_rad**2]
    return Observation(
        agent=source.agent,
        pass_id=f"{source.agent} map",
        time_ns=source.time_ns,
        pose=np.array([*origin, 0.0]),
        covariance=np.diag(np.maximum(variance, (2 * LIMITS.min_pose_std) ** 2)),
        view=view - origin,
        elements=local,
        model="imported map",
        trusted=source.trusted,
        occluders=Polygons.of([hole - origin for hole in holes]),
    )


def _to_rings(piece: BaseGeometry) -> tuple[Floats, list[Floats]]:
    """Return the outline of a polygon and its larger holes as open rings with few enough points."""
    shapely = _shapely()
    for tolerance in (0.0, 1.0, 2.0, 4.0):
        simple = shapely.simplify(piece, tolerance)
        holes = [ring for ring in simple.interiors if shapely.Polygon(ring).area >= _MIN_HOLE_M2]
        holes = sorted(holes, key=lambda ring: -shapely.Polygon(ring).area)[: LIMITS.max_occluders]
        rings = [shapely.get_coordinates(ring)[:-1] for ring in (simple.exterior, *holes)]
        if max(map(len, rings)) <= LIMITS.max_ring_points:
            return rings[0], rings[1:]
    return shapely.get_coordinates(shapely.convex_hull(piece).exterior)[:-1], []
