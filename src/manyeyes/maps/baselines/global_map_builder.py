# SPDX-License-Identifier: Apache-2.0
"""GlobalMapNet's builder (arXiv 2409.10063): observation after observation, the newest replaces what it covers.

Each observation's elements are matched to the map's elements in its view, kind by kind, by the cheapest assignment on the lesser
of both directed mean distances (100 samples to the other line), up to a distance a kind. A matched line replaces the stretch
that it covers, a matched crossing the whole; the unmatched are added. Scores are means weighted by length. At the end elements
are suppressed, by descending score, whose buffers overlap a kept one's by more than a share of their union.

Observations come in order of time, whatever the order of input; that the latest wins is the method's own. Published: every
fourth frame is used, since frames come at 2 Hz; here all are, since observations are tens of metres apart (``observation_stride``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from manyeyes.datatypes.extras import import_extra
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements, Polygons
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
from manyeyes.ops.polyline import close_rings, cut_line, project_onto_line, resample, simplify
from manyeyes.ops.polyline_distance import directed_distance

_shapely = partial(import_extra, "shapely", "map", "Building a map observation by observation")

_FAR_M = 1e4


@dataclass(frozen=True)
class GlobalMapBuilderConfig:
    """Configuration of the baseline.

    max_match_m: by kind (divider, boundary, crossing, stop line), largest distance of a match. buffer_m: by kind, of the
        suppression.
    num_samples: points per line for the distances. simplify_m: before and after a replacement.
    max_buffer_iou: largest IoU of the buffers of two elements. observation_stride: every n-th observation is used. rules:
        pre-filter, score and state.
    """

    max_match_m: tuple[float, float, float, float] = (1.0, 2.0, 0.5, 1.0)
    buffer_m: tuple[float, float, float, float] = (1.0, 2.0, 0.5, 1.0)
    num_samples: int = 100
    simplify_m: float = 1.0
    max_buffer_iou: float = 0.1
    observation_stride: int = 1
    rules: BaselineRules = field(default_factory=BaselineRules)


@dataclass(frozen=True, eq=False)
class _BuiltElement:
    """An element of the growing map: its points, kind, score, length behind the score, and rows of the pool."""

    points: Floats
    kind: int
    score: float
    total_length: float
    source_rows: tuple[int, ...]


@register_map_fusion("global-map-builder", GlobalMapBuilderConfig)
def fuse(
    observations: Sequence[Observation],
    config: GlobalMapBuilderConfig = GlobalMapBuilderConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Return the map after the last observation."""
    element_pool = filter_elements(observations, config.rules)
    start = np.searchsorted(element_pool.observation_of_element, np.arange(len(element_pool.observations) + 1))
    built: list[_BuiltElement] = []
    for k in range(0, len(element_pool.observations), config.observation_stride):
        built = _add_observation(
            built, element_pool, np.arange(start[k], start[k + 1]), _view_polygon(element_pool.observations[k]), config
        )
    kept = _suppress_overlapping(built, config)
    return to_vector_map(
        element_pool, [MergedElement(b.points, b.kind, np.array(b.source_rows)) for b in kept], config.rules, frame
    )


def _add_observation(
    built: list[_BuiltElement], pool: ElementPool, rows: Ints, view: Any, config: GlobalMapBuilderConfig
) -> list[_BuiltElement]:
    """Return the map after one observation, whose elements are rows of the pool."""
    shapely = _shapely()
    lengths = pool.elements.lengths()
    out = list(built)
    for kind in range(len(KINDS)):
        local = rows[pool.elements.kind[rows] == kind]
        if not len(local):
            continue
        known_rows = [
            k for k, b in enumerate(built) if b.kind == kind and shapely.intersects(view, shapely.LineString(b.points))
        ]
        shapes = [pool.elements.polyline(r) for r in local]
        cost = _match_costs(shapes, [built[k].points for k in known_rows], kind, config)
        matched_column = np.full(len(shapes), -1)
        matched, columns = linear_sum_assignment(cost)
        matched_column[matched] = columns
        for shape, row, column in zip(shapes, local.tolist(), matched_column.tolist()):
            score, weight = float(pool.elements.score[row]), float(lengths[row])
            if column < 0 or cost[local.tolist().index(row), column] > config.max_match_m[kind]:
                out.append(_BuiltElement(shape, kind, score, weight, (row,)))
                continue
            old: _BuiltElement = built[known_rows[column]]
            points = shape if kind == CROSSING else replace_covered(old.points, shape, config.simplify_m)
            mean = (old.score * old.total_length + score * weight) / (old.total_length + weight)
            out[known_rows[column]] = _BuiltElement(
                points, kind, mean, old.total_length + weight, (*old.source_rows, row)
            )
    return out


def _match_costs(
    local: Sequence[Floats], known_lines: Sequence[Floats], kind: int, config: GlobalMapBuilderConfig
) -> Floats:
    """Return (N, M) the lesser directed mean distance between each local and each known element."""
    if not known_lines:
        return np.zeros((len(local), 0))
    elements = MapElements.of([*local, *known_lines], kind)
    points, offsets = close_rings(elements.points, elements.offsets, elements.closed)
    dense, dense_first = resample(points, offsets, config.num_samples)
    a, b = np.divmod(np.arange(len(local) * len(known_lines)), len(known_lines))
    pairs = np.stack((a, b + len(local)), 1)
    there = directed_distance(dense, dense_first, points, offsets, pairs)[0]
    back = directed_distance(dense, dense_first, points, offsets, pairs[:, ::-1])[0]
    return np.minimum(np.minimum(there, back), _FAR_M).reshape(len(local), len(known_lines))


def replace_covered(old: Floats, new: Floats, simplify_m: float) -> Floats:
    """Return (K, 2): the old line with the stretch that the new one covers replaced by it, in the old one's direction."""
    old, new = simplify(old, simplify_m), simplify(new, simplify_m)
    along = project_onto_line(new[[0, -1]], old).station_m
    if along[0] > along[1] or (along[0] == along[1] and np.dot(new[-1] - new[0], old[-1] - old[0]) < 0):
        new, along = new[::-1], along[::-1]
    length = float(np.hypot(*np.diff(old, axis=0).T).sum())
    pieces = [new]
    if along[0] > 0.0:
        pieces.insert(0, cut_line(old, 0.0, float(along[0]))[:-1])
    if along[1] < length:
        pieces.append(cut_line(old, float(along[1]), length)[1:])
    return simplify(np.concatenate(pieces), simplify_m)


def _suppress_overlapping(built: Sequence[_BuiltElement], config: GlobalMapBuilderConfig) -> list[_BuiltElement]:
    """What stays of the map: by descending score, ties by length, without those that lie on a kept one."""
    shapely = _shapely()
    kept: list[_BuiltElement] = []
    buffers: list[Any] = []
    for b in sorted(built, key=lambda b: (-b.score, -b.total_length, b.points.tolist())):
        shape = shapely.Polygon(b.points) if b.kind == CROSSING and len(b.points) > 2 else shapely.LineString(b.points)
        buffer = shape.buffer(config.buffer_m[b.kind])
        same = [other for other, k in zip(buffers, kept) if k.kind == b.kind and other.intersects(buffer)]
        if all(o.intersection(buffer).area <= config.max_buffer_iou * o.union(buffer).area for o in same):
            kept.append(b)
            buffers.append(buffer)
    return kept


def _view_polygon(observation: Observation) -> Any:
    """What an observation could see, as a polygon in the map's frame."""
    view = Polygons.of([observation.view])
    ring = MapElements.of([view.ring(0)], CROSSING).transform(*observation.pose.tolist())
    return _shapely().Polygon(ring.points).buffer(1.0)
