# SPDX-License-Identifier: Apache-2.0
"""PolyMerge (Sayed, Perminov, Tsetserukou, arXiv 2310.18416): connected components, lines folded together vertex by vertex.

Two elements of one kind are joined where any vertex of one lies within a distance of the other. A component's lines are
folded, one after the other, into the first: a vertex whose foot lies inside the other line becomes the middle of both, others
lengthen the line. A component's crossings are drawn as hulls on a raster; where the blurred mean of the drawings exceeds a
half is the crossing, and its least rotated rectangle the result.

Quirks of the published program that are not repeated, each of which would cost it: merged elements get the shared score, not
0; members fold in the order of plausibility, not of input; a duplicate is a vertex that agrees in both coordinates, not in
one; no member is changed in place. The growing line is simplified at ``simplify_m``, so that vertices do not multiply.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import (
    BaselineRules,
    ElementPool,
    Floats,
    Ints,
    MergedElement,
    filter_elements,
    to_vector_map,
)
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion
from manyeyes.maps.roads.lane_links import connected_components
from manyeyes.ops.polyline import find_near_pairs, points_at_stations, project_onto_line, simplify
from manyeyes.ops.polyline_distance import min_distance

_shapely = partial(import_extra, "shapely", "map", "Merging crossings")


@dataclass(frozen=True)
class PolyMergeConfig:
    """max_vertex_distance_m: distance of a vertex that joins two elements. cell_m, blur_sigma_m: of the raster and its Gaussian.
    min_fraction: of the drawings that make a crossing. simplify_m: of merged lines. rules: pre-filter, score and state.
    """

    max_vertex_distance_m: float = 1.0
    cell_m: float = 0.1
    blur_sigma_m: float = 0.3
    min_fraction: float = 0.5
    simplify_m: float = 0.05
    rules: BaselineRules = field(default_factory=BaselineRules)


@register_map_fusion("polymerge", PolyMergeConfig)
def fuse(
    observations: Sequence[Observation], config: PolyMergeConfig = PolyMergeConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Return the map of components."""
    element_pool = filter_elements(observations, config.rules)
    merged = []
    for rows in group_elements(element_pool, config.max_vertex_distance_m):
        kind = int(element_pool.elements.kind[rows[0]])
        shapes = [element_pool.elements.polyline(k) for k in rows]
        if kind != CROSSING:
            merged.append(MergedElement(_merge_lines(shapes, config.simplify_m), kind, rows))
        else:
            ring = vote_crossing(shapes, config)
            merged += [] if ring is None else [MergedElement(ring, kind, rows)]
    return to_vector_map(element_pool, merged, config.rules, frame)


def group_elements(pool: ElementPool, max_vertex_distance_m: float) -> list[Ints]:
    """Return rows of the components of one kind, each from the most plausible on."""
    points, offsets = pool.closed_lines()
    kind = pool.elements.kind
    pairs = find_near_pairs(pool.elements.bounds(), max_vertex_distance_m)
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    gap = np.minimum(
        min_distance(points, offsets, points, offsets, pairs),
        min_distance(points, offsets, points, offsets, pairs[:, ::-1]),
    )
    label = connected_components(len(kind), pairs[gap <= max_vertex_distance_m])
    ordered = pool.sort_by_plausibility(np.arange(len(kind)))
    ordered = ordered[np.argsort(label[ordered], kind="stable")]
    return np.split(ordered, np.flatnonzero(np.diff(label[ordered])) + 1) if len(ordered) else []


def _merge_lines(lines: Sequence[Floats], simplify_m: float) -> Floats:
    whole = lines[0]
    for line in lines[1:]:
        whole = simplify(merge_two_lines(whole, line), simplify_m)
    return whole


def merge_two_lines(whole: Floats, line: Floats) -> Floats:
    """Return (K', 2) two lines as one, ordered along the first: middles where they face each other, their own vertices beyond."""
    on_whole = project_onto_line(line, whole)
    order = on_whole.station_m[on_whole.is_interior] if on_whole.is_interior.sum() > 1 else on_whole.station_m
    ahead = order[-1] - order[0] if order[-1] != order[0] else np.dot(line[-1] - line[0], whole[-1] - whole[0])
    if ahead < 0:
        return merge_two_lines(whole, line[::-1])
    on_line = project_onto_line(whole, line)
    length = float(np.hypot(*np.diff(whole, axis=0).T).sum())
    line_vertices = np.where(
        on_whole.is_interior[:, None], (line + points_at_stations(whole, on_whole.station_m)) / 2, line
    )
    # Beyond an end, a vertex is placed by its distance from that end.
    before, after = np.hypot(*(line - whole[0]).T), np.hypot(*(line - whole[-1]).T)
    line_stations = np.where(
        on_whole.is_interior, on_whole.station_m, np.where(on_whole.station_m < length / 2, -before, length + after)
    )
    whole_vertices = np.where(
        on_line.is_interior[:, None], (whole + points_at_stations(line, on_line.station_m)) / 2, whole
    )
    station = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(whole, axis=0).T))))
    points, along = np.concatenate((whole_vertices, line_vertices)), np.concatenate((station, line_stations))
    points = points[np.argsort(along, kind="stable")]
    fresh = np.concatenate(([True], (np.diff(points, axis=0) != 0).any(1)))
    return points[fresh]


def vote_crossing(rings: Sequence[Floats], config: PolyMergeConfig) -> Floats | None:
    """Return (4, 2) the least rotated rectangle of where the blurred share of drawn hulls exceeds the config's; None: nowhere."""
    shapely = _shapely()
    hulls = shapely.convex_hull(np.array([shapely.Polygon(ring) for ring in rings], dtype=object))
    margin = 4 * config.blur_sigma_m
    low = np.concatenate(rings).min(0) - margin
    shape = np.ceil((np.concatenate(rings).max(0) + margin - low) / config.cell_m).astype(int) + 1
    x, y = (low[axis] + config.cell_m * (np.arange(shape[axis]) + 0.5) for axis in range(2))
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    drawn = np.zeros(shape)
    for hull in hulls:
        shapely.prepare(hull)
        drawn += shapely.contains_xy(hull, grid_x, grid_y)
    chosen = blur_image(drawn / len(hulls), config.blur_sigma_m / config.cell_m) > config.min_fraction
    if chosen.sum() < 3:
        return None
    # Corners of cells, so that the rectangle ends where the drawing does and not half a cell before.
    at = np.stack((grid_x[chosen], grid_y[chosen]), 1)
    corners = (at[:, None] + config.cell_m / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])).reshape(-1, 2)
    return fit_rectangle(corners)


def fit_rectangle(points: Floats) -> Floats:
    """Return (4, 2) the corners of the least rotated rectangle around points (K, 2), anticlockwise."""
    shapely = _shapely()
    box = shapely.oriented_envelope(shapely.MultiPoint(points))
    return shapely.get_coordinates(shapely.geometry.polygon.orient(box))[:-1]


def blur_image(image: Floats, sigma_cells: float) -> Floats:
    """Return the image (H, W) under a Gaussian, cut at three sigma and normalised; beyond the border is nothing."""
    if sigma_cells <= 0:
        return image
    radius = int(np.ceil(3 * sigma_cells))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma_cells) ** 2)
    kernel /= kernel.sum()
    for axis in range(2):
        padded = np.pad(image, [(radius, radius) if k == axis else (0, 0) for k in range(2)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(kernel), axis=axis)
        image = windows @ kernel
    return image
