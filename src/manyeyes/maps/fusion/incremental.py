# SPDX-License-Identifier: Apache-2.0
"""A map that takes in one observation at a time, for latency; the fold over all observations stays the canonical map.

An observation is aligned to the map as to one more neighbour (stages 1 and 2 of specs/maps.md 3.4, the map standing
still), then each station it could see gains or loses log-odds and is drawn a little across towards what was seen, and
what no station explains becomes candidate stations. What that costs against the fold is told by :func:`drift`.
Differences on purpose: earlier observations are not moved again, what an agent said of a station before the one
observation last heard is forgotten when its daily sum is capped, and crossings keep their shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import CROSSING, KINDS, STYLES, MapElements, rows_of
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import PUBLISHED, RETIRED, VectorMap
from manyeyes.maps.fusion.coarse_search import best_moves, moved_by
from manyeyes.maps.fusion.coverage import along, looked_at, merged
from manyeyes.maps.fusion.crossings import hulls_of, overlap_of
from manyeyes.maps.fusion.existence import EvidenceConfig, EvidenceParameters, doubled, visibility
from manyeyes.maps.fusion.existence import sights as sights_of
from manyeyes.maps.fusion.fuse import FuseConfig, assemble
from manyeyes.maps.fusion.gauss_newton import normal_equations, step_poses
from manyeyes.maps.fusion.observation_arrays import DAY_NS, FieldsOfView, Sightings, gather, is_line
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, span
from manyeyes.maps.fusion.pose_config import AlignConfig
from manyeyes.maps.fusion.stations import Evidence, StationTable
from manyeyes.ops.nearest_line import nearest_line

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CELL_M = 1.25
_STILL = -1  # the observation that the map's own points belong to: none


@dataclass(frozen=True)
class StreamConfig:
    """fuse: of the fold. gates_m, kernels_m: of the steps to the map. fold_in: candidates that wait before the grid is
    built anew.
    """

    fuse: FuseConfig = field(default_factory=FuseConfig)
    gates_m: tuple[float, ...] = (2.0, 1.3, 0.8, 0.8)
    kernels_m: tuple[float, ...] = (0.8, 0.5, 0.35, 0.35)
    fold_in: int = 20000


@dataclass(frozen=True, eq=False)
class Assimilated:
    """What one observation did: its pose (3,) and covariance (3, 3), stations it confirmed, missed and began."""

    pose: Floats
    covariance: Floats
    confirmed: int
    missed: int
    begun: int


class StreamingMap:
    """A map in memory that observations are added to; holds its own copy of everything."""

    def __init__(self, start: VectorMap, config: StreamConfig = StreamConfig()) -> None:
        self.config, self.frame = config, start.frame
        lines = np.flatnonzero(is_line(start.elements.kind) & (start.state != RETIRED))
        rings = np.flatnonzero(~is_line(start.elements.kind) & (start.state != RETIRED))
        self._rings = _Rows.of(start, rings)
        self._ring_points = [np.array(start.elements.polyline(int(k))) for k in rings]
        self._middles = np.array([ring.mean(0) for ring in self._ring_points]).reshape(-1, 2)
        rows = _Rows.of_points(start, lines)
        xy, tangent = _points_of(start.elements.take(lines))
        order = _order(xy, rows.kind)
        self._main = _Ground.of(xy[order], tangent[order], rows.take(order))
        self._new = _Ground.of(np.zeros((0, 2)), np.zeros((0, 2)), rows.take(order[:0]))
        self._known = [row.tobytes() for row in start.observations]
        self._origin = np.repeat(lines, start.elements.counts[lines])[order]
        self._start = start
        # Of a map nobody knows where its observations looked, but under its lines somebody did.
        kept = start.elements.take(lines)
        self._looked = [along(kept.points, kept.first)]
        # Candidates are sorted anew with every observation; what was heard of them counts them as they came.
        self._arrival = np.zeros(0, np.int64)
        self._heard: list[tuple[Ints, bool, int]] = []
        self._ids = {name: k for k, name in enumerate(self._known)}

    def assimilate(self, observation: Observation) -> Assimilated:
        """Add one observation; one that the map holds already changes nothing."""
        raw = bytes.fromhex(observation.id)
        s = gather([observation], self.config.fuse.align.spacing_m)
        if raw in self._ids:
            return Assimilated(np.array(observation.pose), np.array(observation.covariance), 0, 0, 0)
        pose, covariance = self._align(s)
        self._ids[raw] = len(self._known)
        self._known.append(raw)
        self._looked.append(looked_at(s, pose))
        xy, tangent = s.world(pose)
        weight = 0.04 / (s.sigma**2 + 0.1**2 + covariance[0, 0, 0] / 2 + covariance[0, 1, 1] / 2)
        worth = self.config.fuse.stations.evidence.worth(s.elements.score)[s.element]
        confirmed, missed, explained = 0, 0, np.zeros(len(xy), bool)
        look = _Look.of(s, pose, (xy, tangent, weight, worth), self.config.fuse.stations.evidence)
        for ground in (self._main, self._new):
            hits, misses, near = ground.update(s, look, self.config)
            main = ground is self._main
            self._heard.append((hits if main else self._arrival[hits], main, len(self._known) - 1))
            confirmed, missed, explained = confirmed + len(hits), missed + misses, explained | near
        confirmed, missed = self._cross(s, pose, confirmed, missed)
        fresh = np.flatnonzero(~explained & is_line(s.kind))
        self._begin(s, xy[fresh], tangent[fresh], fresh, worth[fresh])
        if len(self._new) > self.config.fold_in:
            self._fold_in()
        return Assimilated(pose[0], covariance[0], confirmed, missed, len(fresh))

    def map(self) -> VectorMap:
        """The map as it stands, linked to lines."""
        self._fold_in()
        ground, count = self._main, len(self._main)
        listed: list[list[int]] = [[] for _ in range(count)]
        first, sources = self._start.sources_first, self._start.sources
        for k, origin in enumerate(self._origin.tolist()):
            if origin >= 0:
                listed[k] = sources[first[origin] : first[origin + 1]].tolist()
        for rows, _, number in self._heard:
            for k in rows.tolist():
                listed[k].append(number)
        ring_rows = np.flatnonzero(~is_line(self._start.elements.kind) & (self._start.state != RETIRED))
        of_rings = [sources[first[k] : first[k + 1]].tolist() for k in ring_rows.tolist()]
        of_rings += [[] for _ in range(len(self._ring_points) - len(of_rings))]
        ids = np.frombuffer(b"".join(self._known), np.uint8).reshape(-1, 16)
        starts = np.concatenate(([0], np.cumsum([len(r) for r in self._ring_points], dtype=np.int64))).astype(np.int64)
        ring_xy = np.concatenate(self._ring_points) if self._ring_points else np.zeros((0, 2))
        line, ring = ground.rows.evidence(listed, ids), self._rings.evidence(of_rings, ids)
        alive = np.flatnonzero((line.log_odds > 0.0) | (line.state != 0))
        table = StationTable(
            ground.xy[alive], ground.tangent[alive], line.take(alive), starts, ring_xy, ring, self._looked[0]
        )
        return assemble(StationTable.cat([table]), self.config.fuse, self.frame)

    def _align(self, s: Sightings) -> tuple[Floats, Floats]:
        """Pose (1, 3) and covariance (1, 3, 3) of the one observation against the map."""
        config, ground, home = self.config.fuse.align, self._main, np.zeros(1, np.int64)
        one = replace(config, gates_m=self.config.gates_m, kernels_m=self.config.kernels_m, damping=1.0)
        pose, covariance = np.array(s.pose), np.array(s.covariance)
        if not len(ground) or not len(s.xy):
            return pose, covariance
        pose = moved_by(s, home, best_moves(*_search_arguments(s, home, ground.wide, config)))
        begin = pose
        for gate, kernel in zip(one.gates_m, one.kernels_m):
            xy, tangent = s.world(pose)
            sums = normal_equations(
                home,
                (s.first, xy, tangent, s.kind, s.sigma),
                (
                    ground.grid.cell_m,
                    ground.grid.keys,
                    ground.grid.start,
                    ground.xy,
                    ground.tangent,
                    ground.owner,
                    ground.weight,
                ),
                (gate, kernel, one.along_m, float(np.cos(one.heading_rad)), one.sigma_m, one.correlation),
            )
            moved = step_poses(s, home, (begin, np.zeros((1, 3)), pose), sums, one)
            pose, covariance = moved["pose"], moved["covariance"]
        return pose, covariance

    def _cross(self, s: Sightings, pose: Floats, confirmed: int, missed: int) -> tuple[int, int]:
        """Evidence for crossings: overlapped by one of the observation's, or in clear view without."""
        config, rows = self.config.fuse.stations, np.flatnonzero(np.asarray(s.elements.kind) == CROSSING)
        moved = s.elements.transform(*(float(v) for v in pose[0]))
        mine = [hulls_of(np.asarray(moved.polyline(int(k)))) for k in rows]
        worth = config.evidence.worth(s.elements.score[rows])
        used = [False] * len(mine)
        reach = float(s.reach_m[0]) + 5.0
        for k in np.flatnonzero(np.hypot(*(self._middles - pose[0, :2]).T) <= reach).tolist():
            ring, middle = self._ring_points[k], self._middles[k]
            shares = [overlap_of(hull, hulls_of(ring)) for hull in mine]
            best = max(shares, default=0.0)
            if best >= config.polygon.overlap:
                used = [u or share >= config.polygon.overlap for u, share in zip(used, shares)]
                amount = config.evidence.hit * float(worth[int(np.argmax(shares))])
                self._rings.change(np.array([k]), amount, s, True, self.config)
                confirmed += 1
            elif best <= 0.05:
                places = np.concatenate((middle[None], (ring + middle) / 2))
                seen = visibility(places, 0, np.ascontiguousarray(pose), sights_of(s), config.evidence.margin_m)
                if seen > 0.0:
                    self._rings.change(np.array([k]), config.evidence.miss * seen, s, False, self.config)
                    missed += 1
        for k, (hull, known) in enumerate(zip(mine, used)):
            if not known and len(hull) >= 3:
                self._ring_points.append(hull)
                self._middles = np.concatenate((self._middles, hull.mean(0)[None]))
                self._rings = self._rings.grown(np.array([CROSSING]), worth[[k]], s, self.config)
        return confirmed, missed

    def _begin(self, s: Sightings, xy: Floats, tangent: Floats, points: Ints, worth: Floats) -> None:
        """New candidates from points that no station explains, each worth a share of a hit."""
        if not len(xy):
            return
        count = len(self._new)
        rows = self._new.rows.grown(s.kind[points], worth, s, self.config)
        xy, tangent = np.concatenate((self._new.xy, xy)), np.concatenate((self._new.tangent, tangent))
        order = _order(xy, rows.kind)
        self._arrival = np.concatenate((self._arrival, np.arange(count, len(xy))))[order]
        self._new = _Ground.of(xy[order], tangent[order], rows.take(order))
        self._heard.append((np.arange(count, len(xy)), False, len(self._known) - 1))

    def _fold_in(self) -> None:
        """Make candidates part of the main ground, and what was looked at one whole."""
        self._looked = [merged(np.concatenate(self._looked))]
        if not len(self._new):
            return
        both = _Rows.cat(self._main.rows, self._new.rows)
        xy = np.concatenate((self._main.xy, self._new.xy))
        tangent = np.concatenate((self._main.tangent, self._new.tangent))
        order = _order(xy, both.kind)
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        came = np.empty(len(self._new), np.int64)
        came[self._arrival] = place[len(self._main) :]
        self._heard = [((place if main else came)[rows], True, k) for rows, main, k in self._heard]
        self._arrival = self._arrival[:0]
        self._origin = np.concatenate((self._origin, np.full(len(self._new), -1, np.int64)))[order]
        self._main = _Ground.of(xy[order], tangent[order], both.take(order))
        self._new = _Ground.of(np.zeros((0, 2)), np.zeros((0, 2)), both.take(order[:0]))


@dataclass(eq=False)
class _Rows:
    """Evidence columns that change; row by row with stations or rings."""

    kind: Ints
    sigma: Floats
    log_odds: Floats
    support: Ints
    agents: Ints
    state: Ints
    t_first: Ints
    t_last: Ints
    style: Floats
    last_agent: Ints
    day: Ints
    day_sum: Floats

    @classmethod
    def of(cls, m: VectorMap, rows: Ints) -> _Rows:
        """Of the elements ``rows``, one row each."""
        columns = (m.log_odds, m.supporters, m.agents, m.state, m.t_first, m.t_last)
        sigma = np.array([m.elements.sigma[m.elements.first[k]] for k in rows.tolist()])
        return cls._of(m.elements.kind[rows], sigma, tuple(c[rows] for c in columns), m.elements.style[rows])

    @classmethod
    def of_points(cls, m: VectorMap, rows: Ints) -> _Rows:
        """Of the points of the elements ``rows``."""
        _, points = rows_of(m.elements.first, rows)
        owner = m.elements.owner[points]
        t = m.stations
        columns = (t.log_odds, t.support, t.agents, m.state[m.elements.owner], t.t_first, t.t_last)
        return cls._of(
            m.elements.kind[owner], t.sigma[points], tuple(c[points] for c in columns), m.elements.style[owner]
        )

    @classmethod
    def _of(cls, kind: Ints, sigma: Floats, columns: tuple[NDArray, ...], style: Floats) -> _Rows:
        count = len(kind)
        log_odds, support, agents, state, first, last = (np.array(c) for c in columns)
        return cls(
            kind=np.array(kind),
            sigma=np.array(sigma),
            log_odds=log_odds,
            support=support,
            agents=agents,
            state=state,
            t_first=first,
            t_last=last,
            style=np.array(style),
            last_agent=np.full(count, -1, np.int64),
            day=np.zeros(count, np.int64),
            day_sum=np.zeros(count),
        )

    @classmethod
    def cat(cls, one: _Rows, two: _Rows) -> _Rows:
        """Both, in order."""
        return cls(*(np.concatenate((getattr(one, n), getattr(two, n))) for n in cls.__dataclass_fields__))

    def take(self, order: Ints) -> _Rows:
        """The chosen rows, in the order given."""
        return _Rows(*(getattr(self, n)[order] for n in self.__dataclass_fields__))

    def grown(self, kind: Ints, worth: Floats, s: Sightings, config: StreamConfig) -> _Rows:
        """With rows begun by an observation: their kinds (N,) and which share of a hit each is worth (N,)."""
        evidence, time, count = config.fuse.stations.evidence, int(s.time_ns[0]), len(kind)
        odds = np.minimum(evidence.hit * worth, evidence.daily)
        state = np.where(bool(s.trusted[0]) & (odds >= evidence.publish_from(kind)), PUBLISHED, 0)
        one = np.ones(count, np.int64)
        begun = _Rows(
            np.asarray(kind, np.int64),
            np.full(count, 0.3),
            odds,
            one,
            one.copy(),
            state,
            one * time,
            one * time,
            np.full((count, len(STYLES)), 1.0 / len(STYLES)),
            np.full(count, _agent_number(s)),
            one * (time // DAY_NS),
            odds.copy(),
        )
        return _Rows.cat(self, begun)

    def change(self, rows: Ints, amount: float | Floats, s: Sightings, hit: bool, config: StreamConfig) -> None:
        """Add to the log-odds of rows: decayed since they were last heard of, capped by agent and day, clamped; then
        their state.
        """
        evidence, time = config.fuse.stations.evidence, int(s.time_ns[0])
        kinds = np.arange(len(KINDS))
        _change(
            rows,
            np.broadcast_to(np.asarray(amount, np.float64), len(rows)),
            self._columns,
            _Update(time, time // DAY_NS, _agent_number(s), hit, bool(s.trusted[0])),
            _UpdateLimits(
                evidence.daily,
                evidence.clamp,
                float(evidence.publish_agents),
                evidence.retire,
                np.array(evidence.decay_s),
                evidence.publish_from(kinds),
            ),
        )

    @property
    def _columns(self) -> _UpdatedColumns:
        return _UpdatedColumns(
            kind=self.kind,
            log_odds=self.log_odds,
            support=self.support,
            agents=self.agents,
            state=self.state,
            t_last=self.t_last,
            last_agent=self.last_agent,
            day=self.day,
            day_sum=self.day_sum,
        )

    def evidence(self, listed: Sequence[Sequence[int]], ids: NDArray[np.uint8]) -> Evidence:
        """As the fold's table; ``listed``: the observations (rows of ids) of each row."""
        known, place = np.unique(ids, axis=0, return_inverse=True)
        sources = [np.unique(place.reshape(-1)[np.array(one, np.int64)]) for one in listed]
        return Evidence(
            kind=self.kind,
            sigma=self.sigma,
            log_odds=self.log_odds,
            coverage=self.support.astype(np.float64),
            support=self.support,
            agents=self.agents,
            state=self.state,
            t_first=self.t_first,
            t_last=self.t_last,
            style=self.style,
            first=np.concatenate(([0], np.cumsum([len(one) for one in sources]))).astype(np.int64),
            sources=np.concatenate(sources) if sources else np.zeros(0, np.int64),
            observations=known,
        )


class _UpdatedColumns(NamedTuple):
    """The columns of :class:`_Rows` that an observation changes, and the kind."""

    kind: I64x1
    log_odds: F64x1
    support: I64x1
    agents: I64x1
    state: I64x1
    t_last: I64x1
    last_agent: I64x1
    day: I64x1
    day_sum: F64x1


class _Update(NamedTuple):
    """What one observation says of rows: when (ns and day), of which agent, whether it saw them, whether it is surveyed."""

    time_ns: int
    day: int
    agent: int
    is_hit: bool
    trusted: bool


class _UpdateLimits(NamedTuple):
    """Bounds of log-odds; decay_s and publish: (4,) by kind, seconds to 1/e and log-odds from which a row is published."""

    max_daily_change: float
    max_log_odds: float
    min_publish_agents: float
    retire: float
    decay_s: F64x1
    publish: F64x1


@njit(cache=True, nogil=True)
def _change(
    rows: I64x1, amount: F64x1, columns: _UpdatedColumns, now: _Update, numbers: _UpdateLimits
) -> None:  # pragma: no cover - compiled
    """Add amount (N,) to the log-odds of rows (N,), decayed, capped by agent and day and clamped; then set their state."""
    kind, log_odds, support, agents, state, t_last, last_agent, day, day_sum = columns
    time, today, agent, hit, trusted = now
    daily, clamp, least, retire, decay, publish = numbers
    for k, added in zip(rows, amount):
        odds = log_odds[k] * np.exp(-max(0.0, (time - t_last[k]) * 1e-9) / decay[kind[k]])
        same = last_agent[k] == agent and day[k] == today
        before = day_sum[k] if same else 0.0
        after = before + added
        if not trusted:
            after = min(max(after, -daily), daily)
        odds = min(max(odds + after - before, -clamp), clamp)
        log_odds[k], day_sum[k], last_agent[k], day[k] = odds, after, agent, today
        if hit:
            agents[k] += not same
            support[k] += 1
            t_last[k] = max(t_last[k], time)
        if odds <= retire:
            state[k] = RETIRED
        elif hit and odds >= publish[kind[k]] and (trusted or agents[k] >= least):
            state[k] = PUBLISHED


class _Look(NamedTuple):
    """One observation at its pose (1, 3), as :func:`_compare` reads it; order: where its points stand among all."""

    pose: F64x2
    order: I64x1
    points: _LookPoints
    box: _ViewBounds
    sights: FieldsOfView
    numbers: EvidenceParameters

    @classmethod
    def of(
        cls, s: Sightings, pose: Floats, columns: tuple[Floats, Floats, Floats, Floats], evidence: EvidenceConfig
    ) -> _Look:
        """columns: places, tangents, weights and worths of its points."""
        lines = np.flatnonzero(is_line(s.kind))
        xy, tangent, weight, worth = columns
        fine = build_grid(xy[lines, 0], xy[lines, 1], s.kind[lines], _CELL_M)
        order, corner = lines[fine.order], s.world_view(pose)
        points = _LookPoints(fine.keys, fine.start, xy[order], tangent[order], weight[order], worth[order])
        box = _ViewBounds(corner.min(0), corner.max(0))
        return cls(np.ascontiguousarray(pose), order, points, box, sights_of(s), evidence.numbers)


@dataclass(eq=False)
class _Ground:
    """Stations in the order of their grid, so that the compiled loops read them in place."""

    xy: Floats
    tangent: Floats
    rows: _Rows
    grid: PointGrid
    owner: Ints
    weight: Floats

    @classmethod
    def of(cls, xy: Floats, tangent: Floats, rows: _Rows) -> _Ground:
        xy, tangent = np.ascontiguousarray(xy), np.ascontiguousarray(tangent)
        grid = build_grid(xy[:, 0], xy[:, 1], rows.kind, _CELL_M)
        nobody = np.full(len(xy), _STILL, np.int64)
        weight = np.minimum(4.0, rows.support.astype(np.float64))
        return cls(xy, tangent, rows, grid, nobody, weight)

    @cached_property
    def wide(self) -> tuple[Ints, Ints, Floats, Floats, Ints]:
        """The stations as the gross search reads them, where they stood when they were first asked for."""
        grid = build_grid(self.xy[:, 0], self.xy[:, 1], self.rows.kind, 8.0)
        return grid.keys, grid.start, self.xy[grid.order], self.tangent[grid.order], self.owner

    def __len__(self) -> int:
        return len(self.xy)

    def update(self, s: Sightings, look: _Look, config: StreamConfig) -> tuple[Ints, int, NDArray[np.bool_]]:
        """Evidence of one observation: rows confirmed, how many missed, and which of its points (P,) some station
        explains.
        """
        evidence, whole = config.fuse.stations.evidence, np.zeros(len(s.xy), bool)
        if not len(self) or not len(whole):
            return np.zeros(0, np.int64), 0, whole
        near, place, mass, seen, sure, explained = _compare(
            _GridStations(self.grid.keys, self.grid.start, self.xy, self.tangent),
            look,
            len(KINDS),
        )
        hit = mass > 0.0
        rows = near[hit]
        gain = mass[hit] / (mass[hit] + 1.0 / np.maximum(self.rows.sigma[rows], 0.02) ** 2 * 0.04)
        self.rows.change(rows, evidence.hit * sure[hit], s, True, config)
        normal = np.stack((-self.tangent[rows, 1], self.tangent[rows, 0]), 1)
        self.xy[rows] += (gain * place[hit])[:, None] * normal
        self.rows.sigma[rows] = np.maximum(evidence.bias_m, self.rows.sigma[rows] * np.sqrt(1.0 - gain))
        lost = (mass < 0.0) & (seen > 0.0)
        self.rows.change(near[lost], evidence.miss * seen[lost], s, False, config)
        whole[look.order] = explained
        return rows, int(lost.sum()), whole


class _GridStations(NamedTuple):
    """Stations in the order of their grid of _CELL_M: its keys and starts, places (K, 2) and unit tangents (K, 2)."""

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2


class _LookPoints(NamedTuple):
    """Points of one observation's lines in the order of their grid of _CELL_M: its keys and starts, places and unit
    tangents (P, 2) in the map's frame, weights (P,) and shares of a hit (P,).
    """

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2
    weight: F64x1
    worth: F64x1


class _ViewBounds(NamedTuple):
    """The lower and the upper corner (2,) of a box, metres in the map's frame."""

    low: F64x1
    high: F64x1


class _Comparison(NamedTuple):
    """N stations that one observation could see or has a line at: rows; lateral offset (m) of its line there; weight of
    that, -1: no line; visibility; share of a hit. explained: (P,) which of its points, in their grid's order, have a station.
    """

    rows: I64x1
    offset: F64x1
    weight: F64x1
    visibility: F64x1
    worth: F64x1
    explained: Boolx1


@njit(cache=True, nogil=True)
def _compare(ground: _GridStations, look: _Look, kinds: int) -> _Comparison:  # pragma: no cover - compiled
    """Compare the stations in the box of a view with the points seen; those with a line only a little aside are left out."""
    keys, start, xy, tangent = ground
    pkeys, pstart, pxy, ptangent, pweight, pworth = look.points
    numbers, (low, high) = look.numbers, look.box
    reach, across, wide = numbers.max_longitudinal_m, numbers.max_lateral_m, numbers.max_nearby_m
    cosine, radius = numbers.min_cosine, np.hypot(reach, wide)
    explained = np.zeros(len(pxy), np.bool_)
    size, n = 1024, 0
    rows, place, mass = np.empty(size, np.int64), np.empty(size), np.empty(size)
    seen, sure = np.empty(size), np.empty(size)
    spot = np.empty((1, 2))
    for kind in range(kinds):
        if kind == CROSSING:
            continue
        for ix in range(int(np.floor((low[0] - 2.0) / _CELL_M)), int(np.floor((high[0] + 2.0) / _CELL_M)) + 1):
            first, last = span(
                keys, start, kind, ix, int(np.floor((low[1] - 2.0) / _CELL_M)), int(np.floor((high[1] + 2.0) / _CELL_M))
            )
            for k in range(first, last):
                x, y, u, v = xy[k, 0], xy[k, 1], tangent[k, 0], tangent[k, 1]
                total, offset, heavy, certain, beside = 0.0, 0.0, 0.0, 0.0, False
                lowest, highest = int(np.floor((y - radius) / _CELL_M)), int(np.floor((y + radius) / _CELL_M))
                for jx in range(int(np.floor((x - radius) / _CELL_M)), int(np.floor((x + radius) / _CELL_M)) + 1):
                    a, b = span(pkeys, pstart, kind, jx, lowest, highest)
                    for q in range(a, b):
                        ex, ey = pxy[q, 0] - x, pxy[q, 1] - y
                        dot = u * ptangent[q, 0] + v * ptangent[q, 1]
                        if abs(dot) < cosine or ex * ex + ey * ey > radius * radius:
                            continue
                        sign = 1.0 if dot > 0.0 else -1.0
                        norm = np.sqrt(2.0 + 2.0 * abs(dot))
                        mx, my = (u + sign * ptangent[q, 0]) / norm, (v + sign * ptangent[q, 1]) / norm
                        along, aside = abs(ex * mx + ey * my), ey * mx - ex * my
                        if along > reach or abs(aside) > wide:
                            continue
                        beside = True
                        explained[q] = explained[q] or abs(aside) <= across
                        if abs(aside) <= across:
                            w = (1.0 - along / reach) ** 2 + 1e-9
                            total += w
                            offset += w * aside
                            heavy += w * pweight[q]
                            certain += w * pworth[q]
                spot[0, 0], spot[0, 1] = x, y
                visible = visibility(spot, 0, look.pose, look.sights, numbers.margin_m) if not beside else 1.0
                if total <= 0.0 and (beside or visible <= 0.0):
                    continue
                if n == size:
                    size *= 2
                    rows, place = doubled(rows), _longer(place, size)
                    mass, seen, sure = _longer(mass, size), _longer(seen, size), _longer(sure, size)
                rows[n], seen[n], sure[n] = k, visible, certain / total if total > 0.0 else 0.0
                place[n], mass[n] = (offset / total, heavy / total) if total > 0.0 else (0.0, -1.0)
                n += 1
    return _Comparison(rows[:n].copy(), place[:n].copy(), mass[:n].copy(), seen[:n].copy(), sure[:n].copy(), explained)


@njit(cache=True, nogil=True)
def _longer(values: F64x1, size: int) -> F64x1:  # pragma: no cover - compiled
    """The same values at the start of an array of that size."""
    out = np.empty(size)
    out[: len(values)] = values
    return out


def drift(one: VectorMap, two: VectorMap, within_m: float = 0.5) -> float:
    """F-score of two maps' published lines: harmonic mean of the shares of points of each within a distance of the
    other's kind.
    """
    shares = []
    for a, b in ((one.published(), two.published()), (two.published(), one.published())):
        close, total = 0, 0
        kind = a.elements.kind[a.elements.owner]
        for k in np.flatnonzero(is_line(np.arange(len(KINDS)))).tolist():
            others = b.elements.take(np.flatnonzero(b.elements.kind == k))
            points = a.elements.points[kind == k]
            away = nearest_line(points, others.points, others.first, within_m).distance
            close, total = close + int((away <= within_m).sum()), total + len(points)
        shares.append(close / total if total else 1.0)
    return 2 * shares[0] * shares[1] / (shares[0] + shares[1]) if sum(shares) > 0 else 0.0


def _search_arguments(s: Sightings, home: Ints, others: tuple, config: AlignConfig) -> tuple:
    gross = config.gross
    return (
        home,
        np.asarray(s.pose),
        np.asarray(s.trusted),
        (s.first, s.xy, s.tangent, s.kind),
        others,
        np.asarray(s.agent),
        np.array(gross.yaws),
        (gross.reach_m, gross.cell_m, gross.gain, gross.least_m, gross.price),
        gross.stride,
    )


def _points_of(elements: MapElements) -> tuple[Floats, Floats]:
    """Points and unit tangents (P, 2): the chord over both neighbours."""
    points = np.array(elements.points)
    index = np.arange(len(points))
    first, last = elements.first[:-1][elements.owner], elements.first[1:][elements.owner] - 1
    step = points[np.minimum(index + 1, last)] - points[np.maximum(index - 1, first)]
    return points, step / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-12)[:, None]


def _order(xy: Floats, kind: Ints) -> Ints:
    return build_grid(xy[:, 0], xy[:, 1], kind, _CELL_M).order


def _agent_number(s: Sightings) -> int:
    """A number for the agent's name that is the same in every process."""
    return int.from_bytes(s.agents[int(s.agent[0])].encode()[-7:], "little")
