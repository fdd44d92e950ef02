# SPDX-License-Identifier: Apache-2.0
"""GlobalMapNet's builder (arXiv 2409.10063): observation after observation, the newest replaces what it covers.

Each observation's elements are matched to the map's elements in its view, kind by kind, by the cheapest assignment on the lesser
of both directed mean distances (100 samples to the other line), up to a distance a kind. A matched line replaces the stretch
that it covers, a matched crossing the whole; the unmatched are added. Scores are means weighted by length. At the end elements
are suppressed, by descending score, whose buffers overlap a kept one's by more than a share of their union.

Observations come in order of time, whatever the order of input; that the latest wins is the method's own. Published: every
fourth frame is used, since frames come at 2 Hz; here all are, since observations are tens of metres apart (``every``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from manyeyes.datatypes import MissingExtraError
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements, Polygons
from manyeyes.maps.baselines._common import Floats, Ints, Merged, Pool, Rules, as_map, pool
from manyeyes.maps.baselines.assignment import assign
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.ops.polyline import close_rings, feet, part, resample, simplify
from manyeyes.ops.polyline_distance import directed

_FAR_M = 1e4


@dataclass(frozen=True)
class Config:
    """By kind (divider, boundary, crossing, stop line): match_m, distance of a match, and buffer_m, of the suppression.

    samples: of a line for the distances. simplify_m: before and after a replacement. overlap: greatest share of the union of two
    buffers. every: observations used, one of so many. rules: pre-filter, score and state.
    """

    match_m: tuple[float, float, float, float] = (1.0, 2.0, 0.5, 1.0)
    buffer_m: tuple[float, float, float, float] = (1.0, 2.0, 0.5, 1.0)
    samples: int = 100
    simplify_m: float = 1.0
    overlap: float = 0.1
    every: int = 1
    rules: Rules = field(default_factory=Rules)


@dataclass(frozen=True, eq=False)
class _Built:
    """An element of the growing map: its points, kind, score, length behind the score, and rows of the pool."""

    points: Floats
    kind: int
    score: float
    weight: float
    rows: tuple[int, ...]


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The map after the last observation."""
    seen = pool(observations, config.rules)
    start = np.searchsorted(seen.observation, np.arange(len(seen.observations) + 1))
    built: list[_Built] = []
    for k in range(0, len(seen.observations), config.every):
        built = _grown(built, seen, np.arange(start[k], start[k + 1]), _view(seen.observations[k]), config)
    kept = _suppressed(built, config)
    return as_map(seen, [Merged(b.points, b.kind, np.array(b.rows)) for b in kept], config.rules, frame)


def _grown(built: list[_Built], of: Pool, rows: Ints, view: Any, config: Config) -> list[_Built]:
    """The map after one observation, whose elements are rows of the pool."""
    shapely = _shapely()
    lengths = of.elements.lengths()
    out = list(built)
    for kind in range(len(KINDS)):
        local = rows[of.elements.kind[rows] == kind]
        if not len(local):
            continue
        known = [
            k for k, b in enumerate(built) if b.kind == kind and shapely.intersects(view, shapely.LineString(b.points))
        ]
        shapes = [of.elements.polyline(r) for r in local]
        cost = _costs(shapes, [built[k].points for k in known], kind, config)
        taken = assign(cost)
        for shape, row, column in zip(shapes, local.tolist(), taken.tolist()):
            score, weight = float(of.elements.score[row]), float(lengths[row])
            if column < 0 or cost[local.tolist().index(row), column] > config.match_m[kind]:
                out.append(_Built(shape, kind, score, weight, (row,)))
                continue
            old = built[known[column]]
            points = shape if kind == CROSSING else replaced(old.points, shape, config.simplify_m)
            mean = (old.score * old.weight + score * weight) / (old.weight + weight)
            out[known[column]] = _Built(points, kind, mean, old.weight + weight, (*old.rows, row))
    return out


def _costs(local: Sequence[Floats], known: Sequence[Floats], kind: int, config: Config) -> Floats:
    """(N, M) the lesser directed mean distance between each local and each known element."""
    if not known:
        return np.zeros((len(local), 0))
    elements = MapElements.of([*local, *known], kind)
    points, first = close_rings(elements.points, elements.first, elements.closed)
    dense, dense_first = resample(points, first, config.samples)
    a, b = np.divmod(np.arange(len(local) * len(known)), len(known))
    pairs = np.stack((a, b + len(local)), 1)
    there = directed(dense, dense_first, points, first, pairs)[0]
    back = directed(dense, dense_first, points, first, pairs[:, ::-1])[0]
    return np.minimum(np.minimum(there, back), _FAR_M).reshape(len(local), len(known))


def replaced(old: Floats, new: Floats, simplify_m: float) -> Floats:
    """(K, 2) the old line with the stretch that the new one covers replaced by it, in the old one's direction."""
    old, new = simplify(old, simplify_m), simplify(new, simplify_m)
    along = feet(new[[0, -1]], old).along
    if along[0] > along[1] or (along[0] == along[1] and np.dot(new[-1] - new[0], old[-1] - old[0]) < 0):
        new, along = new[::-1], along[::-1]
    length = float(np.hypot(*np.diff(old, axis=0).T).sum())
    pieces = [new]
    if along[0] > 0.0:
        pieces.insert(0, part(old, 0.0, float(along[0]))[:-1])
    if along[1] < length:
        pieces.append(part(old, float(along[1]), length)[1:])
    return simplify(np.concatenate(pieces), simplify_m)


def _suppressed(built: Sequence[_Built], config: Config) -> list[_Built]:
    """What stays of the map: by descending score, ties by length, without those that lie on a kept one."""
    shapely = _shapely()
    kept: list[_Built] = []
    buffers: list[Any] = []
    for b in sorted(built, key=lambda b: (-b.score, -b.weight, b.points.tolist())):
        shape = shapely.Polygon(b.points) if b.kind == CROSSING and len(b.points) > 2 else shapely.LineString(b.points)
        buffer = shape.buffer(config.buffer_m[b.kind])
        same = [other for other, k in zip(buffers, kept) if k.kind == b.kind and other.intersects(buffer)]
        if all(o.intersection(buffer).area <= config.overlap * o.union(buffer).area for o in same):
            kept.append(b)
            buffers.append(buffer)
    return kept


def _view(observation: Observation) -> Any:
    """What an observation could see, as a polygon in the map's frame."""
    view = Polygons.of([observation.view])
    ring = MapElements.of([view.ring(0)], CROSSING).transform(*observation.pose.tolist())
    return _shapely().Polygon(ring.points).buffer(1.0)


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise MissingExtraError("map", "Building a map observation by observation") from error
    return shapely
