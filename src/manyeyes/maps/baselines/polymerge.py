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
from typing import Any

import numpy as np

from manyeyes.datatypes import MissingExtraError
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import Floats, Ints, Merged, Pool, Rules, as_map, pool
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.roads.lane_links import components
from manyeyes.ops.polyline import at_stations, feet, near_pairs, simplify
from manyeyes.ops.polyline_distance import nearest


@dataclass(frozen=True)
class Config:
    """gate_m: distance of a vertex that joins two elements. cell_m, blur_m: of the raster and its Gaussian. share: of the
    drawings that make a crossing. simplify_m: of merged lines. rules: pre-filter, score and state.
    """

    gate_m: float = 1.0
    cell_m: float = 0.1
    blur_m: float = 0.3
    share: float = 0.5
    simplify_m: float = 0.05
    rules: Rules = field(default_factory=Rules)


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The map of components."""
    seen = pool(observations, config.rules)
    merged = []
    for rows in groups(seen, config.gate_m):
        kind = int(seen.elements.kind[rows[0]])
        shapes = [seen.elements.polyline(k) for k in rows]
        if kind != CROSSING:
            merged.append(Merged(_folded(shapes, config.simplify_m), kind, rows))
        else:
            ring = vote(shapes, config)
            merged += [] if ring is None else [Merged(ring, kind, rows)]
    return as_map(seen, merged, config.rules, frame)


def groups(of: Pool, gate_m: float) -> list[Ints]:
    """Rows of the components of one kind, each from the most plausible on."""
    points, first = of.lines()
    kind = of.elements.kind
    pairs = near_pairs(of.elements.bounds(), gate_m)
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    gap = np.minimum(
        nearest(points, first, points, first, pairs), nearest(points, first, points, first, pairs[:, ::-1])
    )
    label = components(len(kind), pairs[gap <= gate_m])
    ordered = of.order(np.arange(len(kind)))
    ordered = ordered[np.argsort(label[ordered], kind="stable")]
    return np.split(ordered, np.flatnonzero(np.diff(label[ordered])) + 1) if len(ordered) else []


def _folded(lines: Sequence[Floats], simplify_m: float) -> Floats:
    whole = lines[0]
    for line in lines[1:]:
        whole = simplify(fold(whole, line), simplify_m)
    return whole


def fold(whole: Floats, line: Floats) -> Floats:
    """(K', 2) two lines as one, ordered along the first: middles where they face each other, their own vertices beyond."""
    on_whole = feet(line, whole)
    order = on_whole.along[on_whole.inside] if on_whole.inside.sum() > 1 else on_whole.along
    ahead = order[-1] - order[0] if order[-1] != order[0] else np.dot(line[-1] - line[0], whole[-1] - whole[0])
    if ahead < 0:
        return fold(whole, line[::-1])
    on_line = feet(whole, line)
    length = float(np.hypot(*np.diff(whole, axis=0).T).sum())
    theirs = np.where(on_whole.inside[:, None], (line + at_stations(whole, on_whole.along)) / 2, line)
    # Beyond an end, a vertex is placed by its distance from that end.
    before, after = np.hypot(*(line - whole[0]).T), np.hypot(*(line - whole[-1]).T)
    where = np.where(on_whole.inside, on_whole.along, np.where(on_whole.along < length / 2, -before, length + after))
    own = np.where(on_line.inside[:, None], (whole + at_stations(line, on_line.along)) / 2, whole)
    station = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(whole, axis=0).T))))
    points, along = np.concatenate((own, theirs)), np.concatenate((station, where))
    points = points[np.argsort(along, kind="stable")]
    fresh = np.concatenate(([True], (np.diff(points, axis=0) != 0).any(1)))
    return points[fresh]


def vote(rings: Sequence[Floats], config: Config) -> Floats | None:
    """(4, 2) the least rotated rectangle of where the blurred share of drawn hulls exceeds the config's; None: nowhere."""
    shapely = _shapely()
    hulls = shapely.convex_hull(np.array([shapely.Polygon(ring) for ring in rings], dtype=object))
    margin = 4 * config.blur_m
    low = np.concatenate(rings).min(0) - margin
    shape = np.ceil((np.concatenate(rings).max(0) + margin - low) / config.cell_m).astype(int) + 1
    x, y = (low[axis] + config.cell_m * (np.arange(shape[axis]) + 0.5) for axis in range(2))
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    drawn = np.zeros(shape)
    for hull in hulls:
        shapely.prepare(hull)
        drawn += shapely.contains_xy(hull, grid_x, grid_y)
    chosen = blurred(drawn / len(hulls), config.blur_m / config.cell_m) > config.share
    if chosen.sum() < 3:
        return None
    # Corners of cells, so that the rectangle ends where the drawing does and not half a cell before.
    at = np.stack((grid_x[chosen], grid_y[chosen]), 1)
    corners = (at[:, None] + config.cell_m / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])).reshape(-1, 2)
    return rectangle(corners)


def rectangle(points: Floats) -> Floats:
    """(4, 2) the corners of the least rotated rectangle around points (K, 2), anticlockwise."""
    shapely = _shapely()
    box = shapely.oriented_envelope(shapely.MultiPoint(points))
    return shapely.get_coordinates(shapely.geometry.polygon.orient(box))[:-1]


def blurred(image: Floats, sigma_cells: float) -> Floats:
    """The image (H, W) under a Gaussian, cut at three sigma and normalised; beyond the border is nothing."""
    if sigma_cells <= 0:
        return image
    reach = int(np.ceil(3 * sigma_cells))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_cells) ** 2)
    kernel /= kernel.sum()
    for axis in range(2):
        padded = np.pad(image, [(reach, reach) if k == axis else (0, 0) for k in range(2)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, len(kernel), axis=axis)
        image = windows @ kernel
    return image


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise MissingExtraError("map", "Merging crossings") from error
    return shapely
