# SPDX-License-Identifier: Apache-2.0
"""One map from many observations: align, find stations, link them to lines, keep their evidence.

The whole of specs/maps.md 3.4 in three steps: :func:`manyeyes.maps.fusion.pose_optimization.solve_poses`,
:func:`manyeyes.maps.fusion.stations.find_stations` and :func:`assemble`. The first two are local and may run tile by tile; the
third takes the stations of all tiles, which are few, so no line is ever cut at a border. The map is a fold over the
sorted set of observations: giving one again, or in another order, changes nothing, and taking one out gives the map
that never had it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, I64x1, njit
from manyeyes.datatypes.map_element import DASHED, MapElements, rows_of
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, RETIRED, Stations, Topology, VectorMap, content_ids
from manyeyes.maps.fusion.coverage import cut_unseen
from manyeyes.maps.fusion.observation_arrays import gather
from manyeyes.maps.fusion.parallel_extension import BesideConfig, continued
from manyeyes.maps.fusion.polyline_linking import LinkConfig, link, smooth
from manyeyes.maps.fusion.pose_config import AlignConfig
from manyeyes.maps.fusion.pose_optimization import Alignment, solve_poses
from manyeyes.maps.fusion.stations import Area, Evidence, StationConfig, StationTable, find_stations, with_style
from manyeyes.maps.fusion.topology import topology_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class FuseConfig:
    """align, stations, link: of the three steps. least_m: shortest line by kind (divider, boundary, crossing, stop
    line).

    full_score_m: length by kind from which a line's score is not lowered.
    """

    align: AlignConfig = field(default_factory=AlignConfig)
    stations: StationConfig = field(default_factory=StationConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    beside: BesideConfig = field(default_factory=BesideConfig)
    least_m: tuple[float, float, float, float] = (2.0, 4.0, 0.0, 2.0)
    full_score_m: tuple[float, float, float, float] = (20.0, 20.0, 0.0, 3.0)


def fuse(
    observations: Sequence[Observation], config: FuseConfig = FuseConfig(), frame: Frame | None = None
) -> VectorMap:
    """The map of the observations, in their frame."""
    return fuse_aligned(observations, solve_poses(observations, config.align), None, config, frame)


def fuse_aligned(
    observations: Sequence[Observation],
    alignment: Alignment,
    area: Area | None = None,
    config: FuseConfig = FuseConfig(),
    frame: Frame | None = None,
) -> VectorMap:
    """The map of the observations at given poses, from the stations in area (x0, y0, x1, y1), or everywhere."""
    sightings = gather(observations, config.align.spacing_m)
    return assemble(find_stations(sightings, alignment, area, config.stations), config, frame)


def assemble(table: StationTable, config: FuseConfig = FuseConfig(), frame: Frame | None = None) -> VectorMap:
    """The map that the stations of all areas make: retired ones for themselves, the others linked to lines."""
    parts = [_lines(table, table.line.state != RETIRED, config), _lines(table, table.line.state == RETIRED, config)]
    whole = _Parts.cat([*parts, _crossings(table)])
    return _as_map(whole, Evidence.cat([table.line, table.ring]), frame or Frame())


@dataclass(frozen=True, eq=False)
class _Parts:
    """Elements on their way: points (P, 2), offsets first (N + 1,), the row of evidence behind each point (P,), and
    whether that place itself was seen (P,) or is inferred.
    """

    points: Floats
    first: Ints
    row: Ints
    seen: NDArray[np.bool_]
    score: Floats

    @classmethod
    def cat(cls, many: Sequence[_Parts]) -> _Parts:
        starts = np.cumsum([0, *(len(m.points) for m in many)])
        return cls(
            np.concatenate([m.points for m in many]),
            np.concatenate([m.first[:-1] + start for m, start in zip(many, starts)] + [starts[-1:]]),
            np.concatenate([m.row for m in many]),
            np.concatenate([m.seen for m in many]),
            np.concatenate([m.score for m in many]),
        )


def _lines(table: StationTable, chosen: NDArray[np.bool_], config: FuseConfig) -> _Parts:
    rows = np.flatnonzero(chosen)
    xy, tangent = table.xy[rows], table.tangent[rows]
    first, members = _linked(table, rows, xy, tangent, config)
    seen = len(rows)
    added, turned, source = continued(
        xy, table.line.kind[rows], table.line.coverage[rows], (first, members), config.beside
    )
    if len(added):
        xy, tangent, rows = (
            np.concatenate((xy, added)),
            np.concatenate((tangent, turned)),
            np.concatenate((rows, rows[source])),
        )
        first, members = _linked(table, rows, xy, tangent, config)
    kind, weight = table.line.kind[rows], 1.0 / table.line.sigma[rows] ** 2
    points = smooth(xy, first, members, weight, config.link.smooth)
    first, kept = cut_unseen(points, first, members >= seen, table.looked)
    points, members = points[kept], members[kept]
    first, order = _canonical(first, points)
    points, members = points[order], members[order]
    length = _lengths(first, points)
    line_kind = kind[members[first[:-1]]] if len(members) else np.zeros(0, np.int64)
    mean = (
        np.add.reduceat(table.line.log_odds[rows][members], first[:-1]) / np.diff(first)
        if len(members)
        else np.zeros(0)
    )
    share = np.minimum(1.0, length / np.array(config.full_score_m)[line_kind].clip(1e-9))
    score = share / (1.0 + np.exp(-mean / 4.0))
    stays = np.flatnonzero(length >= np.array(config.least_m)[line_kind])
    kept, places = rows_of(first, stays)
    return _Parts(points[places], kept, rows[members[places]], members[places] < seen, score[stays])


def _linked(table: StationTable, rows: Ints, xy: Floats, tangent: Floats, config: FuseConfig) -> tuple[Ints, Ints]:
    """Chains of stations at xy with the evidence of the table's rows."""
    line = table.line
    dashed = line.style[rows].argmax(1) == DASHED
    return link(xy, tangent, line.kind[rows], line.log_odds[rows], dashed, line.coverage[rows], config.link)


def _crossings(table: StationTable) -> _Parts:
    offset = len(table.line.kind)
    owner = np.repeat(np.arange(len(table.ring_start) - 1), np.diff(table.ring_start))
    seen = np.ones(len(owner), bool)
    return _Parts(
        table.ring_xy, table.ring_start, offset + owner, seen, 1.0 / (1.0 + np.exp(-table.ring.log_odds / 4.0))
    )


def _as_map(parts: _Parts, evidence: Evidence, frame: Frame) -> VectorMap:
    """Elements in canonical order with the evidence of the rows behind them."""
    count = len(parts.first) - 1
    evidence = with_style(evidence)
    owner = np.repeat(np.arange(count), np.diff(parts.first))
    head = parts.row[parts.first[:-1]]
    row = parts.row
    counts = np.maximum(1, np.diff(parts.first))
    mean = np.bincount(owner, evidence.log_odds[row], count) / counts
    published = np.bincount(owner, (evidence.state[row] == PUBLISHED).astype(np.float64), count) / counts
    state = np.where(evidence.state[head] == RETIRED, RETIRED, np.where(published >= 0.5, PUBLISHED, CANDIDATE))
    style = np.stack(
        [np.bincount(owner, evidence.style[row, s], count) / counts for s in range(evidence.style.shape[1])], 1
    )
    elements = MapElements(
        evidence.kind[head],
        parts.first,
        parts.points,
        parts.score.clip(0.0, 1.0),
        evidence.sigma[row],
        style,
    )
    sources_first, sources = _sources(owner, row, count, evidence)
    stations = Stations(
        *(getattr(evidence, n)[row] * parts.seen for n in ("support", "agents")),
        *(getattr(evidence, n)[row] for n in ("log_odds", "sigma", "t_first", "t_last")),
    )
    t_first, t_last = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(t_first, owner, evidence.t_first[row])
    np.maximum.at(t_last, owner, evidence.t_last[row])
    agents = np.zeros(count, np.int64)
    np.maximum.at(agents, owner, evidence.agents[row])
    return VectorMap(
        frame=frame,
        elements=elements,
        id=content_ids(elements),
        state=state,
        log_odds=mean,
        supporters=np.diff(sources_first),
        agents=agents,
        t_first=t_first,
        t_last=t_last,
        stations=stations,
        topology=_topology(elements, state),
        observations=evidence.observations,
        sources_first=sources_first,
        sources=sources,
    )


def _topology(elements: MapElements, state: Ints) -> Topology:
    """Relations among the elements that are not retired."""
    alive = np.flatnonzero(state != RETIRED)
    return topology_of(elements.take(alive)).renumbered(alive)


def _sources(owner: Ints, row: Ints, count: int, evidence: Evidence) -> tuple[Ints, Ints]:
    """Offsets and observations behind each element, each once, ascending."""
    sizes = np.diff(evidence.first)[row]
    starts = evidence.first[row]
    whose = np.repeat(owner, sizes)
    place = (
        np.arange(int(sizes.sum())) + np.repeat(starts - np.concatenate(([0], np.cumsum(sizes)[:-1])), sizes)
        if len(row)
        else []
    )
    pairs = np.unique(whose * np.int64(len(evidence.observations) + 1) + evidence.sources[np.asarray(place, np.int64)])
    element, source = np.divmod(pairs, np.int64(len(evidence.observations) + 1))
    first = np.concatenate(([0], np.cumsum(np.bincount(element, minlength=count)))).astype(np.int64)
    return first, source


def _canonical(first: Ints, points: Floats) -> tuple[Ints, Ints]:
    """Offsets and an order of the points in which chains stand by their first point and start at their lesser end."""
    if not len(points):
        return np.zeros(1, np.int64), np.zeros(0, np.int64)
    head, tail = points[first[:-1]], points[first[1:] - 1]
    turned = (tail[:, 0] < head[:, 0]) | ((tail[:, 0] == head[:, 0]) & (tail[:, 1] < head[:, 1]))
    start = np.where(turned[:, None], tail, head)
    walk = np.lexsort((start[:, 1], start[:, 0]))
    order = _walk(first, walk, turned)
    return np.concatenate(([0], np.cumsum(np.diff(first)[walk]))).astype(np.int64), order


@njit(cache=True, nogil=True)
def _walk(first: I64x1, walk: I64x1, turned: Boolx1) -> I64x1:  # pragma: no cover - compiled
    order, n = np.empty(first[-1], np.int64), 0
    for c in walk:
        size = first[c + 1] - first[c]
        for i in range(size):
            order[n] = first[c + 1] - 1 - i if turned[c] else first[c] + i
            n += 1
    return order


def _lengths(first: Ints, points: Floats) -> Floats:
    """(L,) metres along each chain."""
    if len(points) == 0:
        return np.zeros(0)
    step = np.concatenate((np.hypot(*np.diff(points, axis=0).T), [0.0]))
    step[first[1:] - 1] = 0.0
    return np.add.reduceat(step, first[:-1])
