# SPDX-License-Identifier: Apache-2.0
"""From aligned observations to stations: the local half of the fusion, which a tile can do alone.

Stages 3, 4, 6 and 7 of specs/maps.md 3.4. What a station is depends on observations within a few tens of metres and on
nothing else, so the stations of an area are the same whether it is one tile or four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import CROSSING, STYLES, rows_of
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, RETIRED
from manyeyes.maps.fusion.agent_weights import NOT_BELIEVED, looks_weight
from manyeyes.maps.fusion.coverage import looked_at, merged
from manyeyes.maps.fusion.crossings import Crossings, PolygonConfig, find_crossings
from manyeyes.maps.fusion.existence import EvidenceConfig, Witness, vouched, witness
from manyeyes.maps.fusion.mean_shift import RidgeConfig, shift_to_ridges, thin
from manyeyes.maps.fusion.observation_arrays import Sightings, is_line
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, span
from manyeyes.maps.fusion.pose_optimization import Alignment, bounded

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Digests = NDArray[np.uint8]

_RIVAL_CELL_M = 2.5

Area = tuple[float, float, float, float]


@dataclass(frozen=True)
class StationConfig:
    """most: observations that shape a ridge in a cell of 8 m, class and heading. halo_m: of an area, where ridges are
    found too.

    vouched: what an agent whom nobody believes says of lines counts only where fewer believed agents looked. least_support:
    observations that a station needs, where at least seen_by (summed visibility) could have seen it.
    rival_m: stations of two kinds of line this close across, or of one kind within rival_far_m, exclude each other
    unless the same observations saw both: the one with the smaller log-odds goes if the ratio of supports, or the
    difference of log-odds, is that large.
    """

    most: int = 32
    halo_m: float = 24.0
    vouched: int = 5
    least_support: int = 1
    seen_by: float = 3.0
    rival_m: float = 0.6
    rival_far_m: float = 2.0
    rival_ratio: float = 1.5
    rival_odds: float = 3.0
    ridge: RidgeConfig = field(default_factory=RidgeConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    polygon: PolygonConfig = field(default_factory=PolygonConfig)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What K stations or crossings share: columns as in evidence.Witness; ``sources`` count in observations (U, 16),
    each station's and the observations ascending.
    """

    kind: Ints
    sigma: Floats
    log_odds: Floats
    coverage: Floats
    support: Ints
    agents: Ints
    state: Ints
    t_first: Ints
    t_last: Ints
    style: Floats
    first: Ints
    sources: Ints
    observations: Digests

    def take(self, rows: Ints) -> Evidence:
        """The chosen rows, in the order given."""
        first, places = rows_of(self.first, rows)
        columns = {name: getattr(self, name)[rows] for name in _PER_ROW}
        return Evidence(first=first, sources=self.sources[places], observations=self.observations, **columns)

    @classmethod
    def cat(cls, many: Sequence[Evidence]) -> Evidence:
        """Several as one, in order, their observations merged."""
        known, place = np.unique(np.concatenate([e.observations for e in many]), axis=0, return_inverse=True)
        seen = np.cumsum([0, *(len(e.observations) for e in many)])
        counts = np.concatenate([np.diff(e.first) for e in many])
        return cls(
            first=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
            sources=np.concatenate([place.reshape(-1)[start + e.sources] for e, start in zip(many, seen)]),
            observations=known,
            **{name: np.concatenate([getattr(e, name) for e in many]) for name in _PER_ROW},
        )


_PER_ROW = tuple(f.name for f in fields(Evidence) if f.name not in ("first", "sources", "observations"))


@dataclass(frozen=True, eq=False)
class StationTable:
    """Stations of lines and whole crossings of an area, with their evidence.

    xy, tangent: (K, 2) metres and unit, map frame; line: (K,) their evidence. ring_start: (C + 1,), ring_xy: crossings'
    rings; ring: (C,) their evidence. looked: (R, 3) runs of ground that was in some view (maps.looked); none: not known.
    """

    xy: Floats
    tangent: Floats
    line: Evidence
    ring_start: Ints
    ring_xy: Floats
    ring: Evidence
    looked: Ints

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def cat(cls, many: Sequence[StationTable]) -> StationTable:
        """The stations of several areas that do not overlap as one table, in an order that does not depend on the
        areas.
        """
        xy = np.concatenate([t.xy for t in many])
        tangent = np.concatenate([t.tangent for t in many])
        line, ring = Evidence.cat([t.line for t in many]), Evidence.cat([t.ring for t in many])
        points = np.concatenate([t.ring_xy for t in many])
        sizes = np.concatenate([np.diff(t.ring_start) for t in many])
        start = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
        order = np.lexsort((xy[:, 1], xy[:, 0], line.kind))
        rings = np.lexsort((points[start[:-1], 1], points[start[:-1], 0])) if len(sizes) else np.zeros(0, np.int64)
        ring_start, places = rows_of(start, rings)
        looked = merged(np.concatenate([t.looked for t in many]))
        return cls(xy[order], tangent[order], line.take(order), ring_start, points[places], ring.take(rings), looked)


def find_stations(
    sightings: Sightings, alignment: Alignment, area: Area | None = None, config: StationConfig = StationConfig()
) -> StationTable:
    """Stations and crossings in area (x0, y0, x1, y1), lower sides included, upper excluded; None is everywhere.

    ``sightings`` are all observations that reach into the area widened by the halo; ``pose`` has them all.
    """
    rows = alignment.rows(sightings.ids)
    pose, covariance = alignment.pose[rows], alignment.covariance[rows]
    weight = looks_weight(sightings, alignment.start[rows], alignment.scale[rows], alignment.faith[rows])
    believed = alignment.faith[rows] > NOT_BELIEVED
    lines = _lines(sightings, pose, covariance, (weight, believed), area, config)
    rank = np.argsort(np.argsort(np.array(sightings.ids)))
    crossings = find_crossings(sightings, pose, weight, rank, config.polygon, config.evidence)
    ring, ring_start, ring_xy = _rings_inside(crossings, sightings, area, config)
    looked = looked_at(sightings, pose, area)
    return StationTable.cat([StationTable(*lines, ring_start, ring_xy, ring, looked)])


def _lines(
    sightings: Sightings,
    pose: Floats,
    covariance: Floats,
    standing: tuple[Floats, NDArray[np.bool_]],
    area: Area | None,
    config: StationConfig,
) -> tuple[Floats, Floats, Evidence]:
    """Positions, tangents and evidence of line stations in the area. standing: weight and belief (O,) of observations."""
    xy, tangent = sightings.world(pose)
    weight, believed = standing
    point_weight = _information(sightings, xy, tangent, pose, covariance) * weight[sightings.observation]
    point_weight[vouched(sightings, pose, believed, config.vouched, config.evidence.margin_m)] = 0.0
    counts = np.flatnonzero(bounded(sightings, pose, config.most) & is_line(sightings.kind) & (point_weight > 0.0))
    inside = _within(xy[counts], area, config.halo_m)
    places, turned, _ = shift_to_ridges(
        np.flatnonzero(inside), xy[counts], tangent[counts], sightings.kind[counts], point_weight[counts], config.ridge
    )
    seeds = counts[inside]
    kept = thin(places, turned, sightings.kind[seeds], sightings.priority[seeds], config.ridge)
    seeds, places, turned = seeds[kept], places[kept], turned[kept]
    kind = sightings.kind[seeds]
    found = witness(places, turned, kind, sightings, pose, point_weight, believed, config.evidence)
    normal = np.stack((-turned[:, 1], turned[:, 0]), 1)
    places = places + found.shift[:, None] * normal
    enough = (found.support >= config.least_support) | (found.coverage < config.seen_by)
    stays = np.flatnonzero((found.support > 0) & (enough | (found.state == RETIRED)))
    again = thin(places[stays], turned[stays], kind[stays], sightings.priority[seeds[stays]], config.ridge)
    stays = stays[again]
    table = _published_seldom(_evidence_of(found, kind, sightings).take(stays), config.evidence)
    places, turned = places[stays], turned[stays]
    loses = _rivals(places, turned, table, config)
    chosen = np.flatnonzero(_within(places, area, 0.0) & ~loses & ((table.log_odds > 0.0) | (table.state != 0)))
    return places[chosen], turned[chosen], table.take(chosen)


def _evidence_of(found: Witness | Crossings, kind: Ints, sightings: Sightings) -> Evidence:
    names = [name for name in _PER_ROW if name != "kind"]
    ids = np.frombuffer(bytes.fromhex("".join(sightings.ids)), np.uint8).reshape(-1, 16)
    known, place = np.unique(ids, axis=0, return_inverse=True)
    columns = {name: getattr(found, name) for name in names}
    sources = place.reshape(-1)[found.sources]
    owner = np.repeat(np.arange(len(kind)), np.diff(found.first))
    return Evidence(
        kind=kind, first=found.first, sources=sources[np.lexsort((sources, owner))], observations=known, **columns
    )


def _published_seldom(table: Evidence, config: EvidenceConfig) -> Evidence:
    """The table with those candidates published that few could have seen and that are likely enough for that."""
    seldom = (table.coverage <= config.seldom) & (table.log_odds >= config.publish_seldom)
    seldom &= (table.state == CANDIDATE) & (table.agents >= config.publish_agents)
    return replace(table, state=np.where(seldom, PUBLISHED, table.state))


def _information(sightings: Sightings, xy: Floats, tangent: Floats, pose: Floats, covariance: Floats) -> Floats:
    """(P,) 1 / variance across the line, by detection and pose, in units of that of a point seen to 0.2 m."""
    owner = sightings.observation
    normal = np.stack((-tangent[:, 1], tangent[:, 0]), 1)
    lever = xy - pose[owner, :2]
    jacobian = np.concatenate((normal, (normal[:, 1] * lever[:, 0] - normal[:, 0] * lever[:, 1])[:, None]), 1)
    spread = np.einsum("pi,pij,pj->p", jacobian, covariance[owner], jacobian)
    return 0.04 / (sightings.sigma**2 + 0.1**2 + spread)


def _within(xy: Floats, area: Area | None, halo: float) -> NDArray[np.bool_]:
    if area is None:
        return np.ones(len(xy), bool)
    x, y = xy[:, 0], xy[:, 1]
    return (x >= area[0] - halo) & (x < area[2] + halo) & (y >= area[1] - halo) & (y < area[3] + halo)


def _rivals(xy: Floats, tangent: Floats, table: Evidence, config: StationConfig) -> NDArray[np.bool_]:
    """(K,) which stations lose against another that cannot be true at the same time."""
    grid = build_grid(xy[:, 0], xy[:, 1], np.zeros(len(xy), np.int64), _RIVAL_CELL_M)
    numbers = _RivalLimits(config.rival_m, config.rival_far_m, config.rival_ratio, config.rival_odds)
    standing = _RivalColumns(table.kind, table.log_odds, table.support, table.state, table.first, table.sources)
    return _losers(xy, tangent, standing, grid, numbers)


class _RivalColumns(NamedTuple):
    """The columns of :class:`Evidence` that decide which of two stations stays."""

    kind: I64x1
    log_odds: F64x1
    support: I64x1
    state: I64x1
    first: I64x1
    sources: I64x1


class _RivalLimits(NamedTuple):
    """Lateral distances (m) within which stations of two kinds, and of one kind, exclude each other; least advantages of
    the one that stays: ratio of supports, difference of log-odds.
    """

    max_lateral_m: float
    max_lateral_same_kind_m: float
    min_support_ratio: float
    min_log_odds_difference: float


@njit(cache=True, nogil=True)
def _losers(
    xy: F64x2, tangent: F64x2, standing: _RivalColumns, grid: PointGrid, numbers: _RivalLimits
) -> Boolx1:  # pragma: no cover - compiled
    """(K,) which stations, at xy (K, 2) with unit tangents (K, 2), lose against another."""
    kind, odds, support, state, first, sources = standing
    keys, start, order = grid.keys, grid.start, grid.order
    near, far, ratio, difference = numbers
    loses = np.zeros(len(xy), np.bool_)
    for k in range(len(xy)):
        u, v = tangent[k, 0], tangent[k, 1]
        ix, iy = int(np.floor(xy[k, 0] / _RIVAL_CELL_M)), int(np.floor(xy[k, 1] / _RIVAL_CELL_M))
        for dx in range(-1, 2):
            low, high = span(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for place in range(low, high):
                q = order[place]
                if q == k or state[q] == RETIRED or state[k] == RETIRED:
                    continue
                ex, ey = xy[q, 0] - xy[k, 0], xy[q, 1] - xy[k, 1]
                aside = abs(ey * u - ex * v)
                if abs(ex * u + ey * v) > 1.0 or aside > far or abs(u * tangent[q, 0] + v * tangent[q, 1]) < 0.93:
                    continue
                if kind[q] != kind[k]:
                    wins = aside < near and support[q] > ratio * support[k] and odds[q] >= odds[k]
                else:
                    wins = odds[q] > odds[k] + difference and support[q] >= 3
                # Two lines that the same observations saw are two lines; else they are two readings of one.
                if wins and 4 * _shared(sources, first, k, q) < min(support[k], support[q]):
                    loses[k] = True
    return loses


@njit(cache=True, nogil=True)
def _shared(sources: I64x1, first: I64x1, k: int, q: int) -> int:  # pragma: no cover - compiled
    """How many observations saw both stations; each one's sources ascend."""
    both, i, j = 0, first[k], first[q]
    while i < first[k + 1] and j < first[q + 1]:
        if sources[i] == sources[j]:
            both += 1
            i += 1
            j += 1
        elif sources[i] < sources[j]:
            i += 1
        else:
            j += 1
    return both


def _rings_inside(
    crossings: Crossings, sightings: Sightings, area: Area | None, config: StationConfig
) -> tuple[Evidence, Ints, Floats]:
    """Evidence, offsets and rings of the crossings whose centre lies in the area."""
    count = len(crossings.support)
    table = _evidence_of(crossings, np.full(count, CROSSING, np.int64), sightings)
    counts = np.diff(crossings.start)
    owner = np.repeat(np.arange(count), counts)
    centre = np.stack([np.bincount(owner, crossings.xy[:, axis], count) / np.maximum(1, counts) for axis in (0, 1)], 1)
    enough = (table.support >= config.least_support) | (table.coverage < config.seen_by)
    alive = ((table.log_odds > 0.0) & enough) | (table.state == PUBLISHED) | (table.state == RETIRED)
    chosen = np.flatnonzero(_within(centre, area, 0.0) & alive & (table.support > 0))
    start, places = rows_of(crossings.start, chosen)
    return table.take(chosen), start, crossings.xy[places]


def with_style(table: Evidence) -> Evidence:
    """The same with style votes as probabilities (K, S); without votes all alike."""
    total = table.style.sum(1, keepdims=True)
    return replace(table, style=np.where(total > 0, table.style / np.maximum(total, 1e-12), 1.0 / len(STYLES)))
