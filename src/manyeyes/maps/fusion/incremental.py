# SPDX-License-Identifier: Apache-2.0
"""Incremental map update, one observation at a time, for low latency; the batch fusion remains the reference.

An observation is aligned to the fixed map by the coarse search and Gauss-Newton steps of the batch fusion. Each station that it
covers gains or loses log-odds and is shifted laterally towards the detection. Points that match no station become candidate
stations. :func:`compute_map_fscore` measures the difference from the batch fusion. By design, earlier poses are not corrected
again, the daily bound keeps only the last agent's sum per station, and crossings keep their shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit, set_row
from manyeyes.datatypes.map_element import CROSSING, KINDS, STYLES, MapElements, take_rows
from manyeyes.maps.elements.observation import Observation
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, RETIRED, VectorMap
from manyeyes.maps.fusion.coarse_search import (
    DrawnPoints,
    apply_shifts,
    count_half_turns,
    find_best_shifts,
    to_searched_observations,
)
from manyeyes.maps.fusion.coverage import find_cells_under_lines, find_observed_cells, merge_runs
from manyeyes.maps.fusion.crossings import compute_convex_hull, compute_overlap
from manyeyes.maps.fusion.existence import (
    POINT_VARIANCE_M2,
    EvidenceConfig,
    EvidenceParameters,
    EvidenceTable,
    compute_mean_visibility,
    doubled,
    gather_visibility_rings,
)
from manyeyes.maps.fusion.fuse import MapFusionConfig, assemble_map
from manyeyes.maps.fusion.gauss_newton import build_normal_equations, step_poses
from manyeyes.maps.fusion.observation_arrays import (
    DAY_NS,
    FieldsOfView,
    ObservationArrays,
    is_line,
    to_observation_arrays,
)
from manyeyes.maps.fusion.point_grid import PointGrid, build_grid, find_cell_range, line_residual
from manyeyes.maps.fusion.stations import StationTable
from manyeyes.ops.nearest_line import find_nearest_line

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CELL_M = 1.25
_NO_OBSERVATION = -1  # the observation index of the map's own points: none


@dataclass(frozen=True)
class IncrementalConfig:
    """Configuration of the incremental map.

    fusion: configuration of the batch fusion. gates_m, kernels_m: of the alignment steps.
    max_candidates: number of candidate stations after which they are merged into the main grid.
    """

    fusion: MapFusionConfig = field(default_factory=MapFusionConfig)
    gates_m: tuple[float, ...] = (2.0, 1.3, 0.8, 0.8)
    kernels_m: tuple[float, ...] = (0.8, 0.5, 0.35, 0.35)
    max_candidates: int = 20000


@dataclass(frozen=True, eq=False)
class UpdateResult:
    """Result of one update: pose (3,) and covariance (3, 3) of the observation, stations confirmed, missed and created."""

    pose: Floats
    covariance: Floats
    num_confirmed: int
    num_missed: int
    num_created: int


class IncrementalMap:
    """A map in memory that observations are added to; it copies the initial map."""

    def __init__(self, start: VectorMap, config: IncrementalConfig = IncrementalConfig()) -> None:
        self.config, self.frame = config, start.frame
        lines = np.flatnonzero(is_line(start.elements.kind) & (start.state != RETIRED))
        rings = np.flatnonzero(~is_line(start.elements.kind) & (start.state != RETIRED))
        self._rings = _EvidenceRows.of(start, rings)
        self._ring_points = [np.array(start.elements.polyline(int(k))) for k in rings]
        self._ring_centers = np.array([ring.mean(0) for ring in self._ring_points]).reshape(-1, 2)
        rows = _EvidenceRows.of_points(start, lines)
        xy, tangent = _points_and_tangents(start.elements.take(lines))
        order = _order(xy, rows.evidence.kind)
        self._merged_stations = _StationGrid.of(xy[order], tangent[order], rows.take(order))
        self._candidate_stations = _StationGrid.of(np.zeros((0, 2)), np.zeros((0, 2)), rows.take(order[:0]))
        self._observation_ids = [row.tobytes() for row in start.observations]
        self._origin = np.repeat(lines, start.elements.counts[lines])[order]
        self._start = start
        # The views of the initial map are unknown; the cells under its lines are observed.
        kept = start.elements.take(lines)
        self._observed_cells = [find_cells_under_lines(kept.points, kept.offsets)]
        # Candidates are sorted again after every observation; the support log counts them in order of creation.
        self._candidate_order = np.zeros(0, np.int64)
        self._support_log: list[tuple[Ints, bool, int]] = []
        self._observation_rows = {name: k for k, name in enumerate(self._observation_ids)}

    def update(self, observation: Observation) -> UpdateResult:
        """Add one observation; an observation that the map already contains changes nothing."""
        raw = bytes.fromhex(observation.id)
        s = to_observation_arrays([observation], self.config.fusion.pose_solver.spacing_m)
        if raw in self._observation_rows:
            return UpdateResult(np.array(observation.pose), np.array(observation.covariance), 0, 0, 0)
        pose, covariance = self._estimate_pose(s)
        self._observation_rows[raw] = len(self._observation_ids)
        self._observation_ids.append(raw)
        self._observed_cells.append(find_observed_cells(s, pose))
        xy, tangent = s.to_world(pose)
        weight = POINT_VARIANCE_M2 / (s.sigma**2 + 0.1**2 + covariance[0, 0, 0] / 2 + covariance[0, 1, 1] / 2)
        score_weight = self.config.fusion.stations.evidence.score_weight(s.elements.score)[s.element_of_point]
        confirmed, missed, explained = 0, 0, np.zeros(len(xy), bool)
        placed = _PlacedObservation.of(
            s, pose, (xy, tangent, weight, score_weight), self.config.fusion.stations.evidence
        )
        for station_grid in (self._merged_stations, self._candidate_stations):
            hits, misses, near = station_grid.update(s, placed, self.config)
            main = station_grid is self._merged_stations
            self._support_log.append(
                (hits if main else self._candidate_order[hits], main, len(self._observation_ids) - 1)
            )
            confirmed, missed, explained = confirmed + len(hits), missed + misses, explained | near
        confirmed, missed = self._update_crossings(s, pose, confirmed, missed)
        unexplained = np.flatnonzero(~explained & is_line(s.kind_of_point))
        self._add_candidates(s, xy[unexplained], tangent[unexplained], unexplained, score_weight[unexplained])
        if len(self._candidate_stations) > self.config.max_candidates:
            self._merge_candidates()
        return UpdateResult(pose[0], covariance[0], confirmed, missed, len(unexplained))

    def build_map(self) -> VectorMap:
        """Build the map from the current stations, linked to lines."""
        self._merge_candidates()
        station_grid, count = self._merged_stations, len(self._merged_stations)
        sources_of_station: list[list[int]] = [[] for _ in range(count)]
        offsets, sources = self._start.source_offsets, self._start.sources
        for k, origin in enumerate(self._origin.tolist()):
            if origin >= 0:
                sources_of_station[k] = sources[offsets[origin] : offsets[origin + 1]].tolist()
        for rows, _, number in self._support_log:
            for k in rows.tolist():
                sources_of_station[k].append(number)
        ring_rows = np.flatnonzero(~is_line(self._start.elements.kind) & (self._start.state != RETIRED))
        of_rings = [sources[offsets[k] : offsets[k + 1]].tolist() for k in ring_rows.tolist()]
        of_rings += [[] for _ in range(len(self._ring_points) - len(of_rings))]
        ids = np.frombuffer(b"".join(self._observation_ids), np.uint8).reshape(-1, 16)
        starts = np.concatenate(([0], np.cumsum([len(r) for r in self._ring_points], dtype=np.int64))).astype(np.int64)
        ring_xy = np.concatenate(self._ring_points) if self._ring_points else np.zeros((0, 2))
        line, ring = station_grid.rows.to_table(sources_of_station, ids), self._rings.to_table(of_rings, ids)
        alive = np.flatnonzero((line.log_odds > 0.0) | (line.state != 0))
        table = StationTable(
            station_grid.xy[alive],
            station_grid.tangent[alive],
            line.take(alive),
            starts,
            ring_xy,
            ring,
            self._observed_cells[0],
        )
        return assemble_map(StationTable.cat([table]), self.config.fusion, self.frame)

    def _estimate_pose(self, s: ObservationArrays) -> tuple[Floats, Floats]:
        """Estimate the pose (1, 3) and covariance (1, 3, 3) of one observation against the map."""
        config, station_grid, home = self.config.fusion.pose_solver, self._merged_stations, np.zeros(1, np.int64)
        one = replace(config, damping=1.0)
        pose, covariance = np.array(s.pose), np.array(s.covariance)
        if not len(station_grid) or not len(s.xy):
            return pose, covariance
        pose = apply_shifts(
            s,
            home,
            find_best_shifts(
                home, to_searched_observations(s), station_grid.coarse_grid, config.coarse_search.kernel_params
            ),
        )
        begin = pose
        for gate, kernel in zip(self.config.gates_m, self.config.kernels_m):
            xy, tangent = s.to_world(pose)
            sums = build_normal_equations(
                home,
                (s.observation_offsets, xy, tangent, s.kind_of_point, s.sigma),
                (
                    station_grid.grid.cell_m,
                    station_grid.grid.keys,
                    station_grid.grid.offsets,
                    station_grid.xy,
                    station_grid.tangent,
                    station_grid.observation_of_point,
                    station_grid.weight,
                ),
                (
                    gate,
                    kernel,
                    one.max_longitudinal_m,
                    float(np.cos(one.max_heading_rad)),
                    one.sigma_m,
                    one.points_per_independent,
                ),
            )
            pose, covariance = step_poses(s, home, (begin, pose), sums, one)
        return pose, covariance

    def _update_crossings(self, s: ObservationArrays, pose: Floats, confirmed: int, missed: int) -> tuple[int, int]:
        """Update the crossings that overlap one of the observation's, or that it covers without a detection."""
        config, rows = self.config.fusion.stations, np.flatnonzero(np.asarray(s.elements.kind) == CROSSING)
        moved = s.elements.transform(*(float(v) for v in pose[0]))
        own_hulls = [compute_convex_hull(np.asarray(moved.polyline(int(k)))) for k in rows]
        score_weight = config.evidence.score_weight(s.elements.score[rows])
        is_matched = [False] * len(own_hulls)
        radius = float(s.radius_m[0]) + 5.0
        for k in np.flatnonzero(np.hypot(*(self._ring_centers - pose[0, :2]).T) <= radius).tolist():
            ring, middle = self._ring_points[k], self._ring_centers[k]
            shares = [compute_overlap(hull, compute_convex_hull(ring)) for hull in own_hulls]
            best = max(shares, default=0.0)
            if best >= config.polygon.min_overlap:
                is_matched = [u or share >= config.polygon.min_overlap for u, share in zip(is_matched, shares)]
                amount = config.evidence.log_odds_hit(bool(s.trusted[0])) * float(score_weight[int(np.argmax(shares))])
                self._rings.add_log_odds(np.array([k]), amount, s, True, self.config)
                confirmed += 1
            elif best <= 0.05:
                places = np.concatenate((middle[None], (ring + middle) / 2))
                seen = compute_mean_visibility(
                    places, 0, np.ascontiguousarray(pose), gather_visibility_rings(s), config.evidence.view_margin_m
                )
                if seen > 0.0:
                    self._rings.add_log_odds(np.array([k]), config.evidence.log_odds_miss * seen, s, False, self.config)
                    missed += 1
        for k, (hull, known) in enumerate(zip(own_hulls, is_matched)):
            if not known and len(hull) >= 3:
                self._ring_points.append(hull)
                self._ring_centers = np.concatenate((self._ring_centers, hull.mean(0)[None]))
                self._rings = self._rings.append_created(np.array([CROSSING]), score_weight[[k]], s, self.config)
        return confirmed, missed

    def _add_candidates(
        self, s: ObservationArrays, xy: Floats, tangent: Floats, points: Ints, score_weight: Floats
    ) -> None:
        """Add candidate stations at points that match no station; score_weight: (N,) weight of each detection."""
        if not len(xy):
            return
        count = len(self._candidate_stations)
        rows = self._candidate_stations.rows.append_created(s.kind_of_point[points], score_weight, s, self.config)
        xy, tangent = (
            np.concatenate((self._candidate_stations.xy, xy)),
            np.concatenate((self._candidate_stations.tangent, tangent)),
        )
        order = _order(xy, rows.evidence.kind)
        self._candidate_order = np.concatenate((self._candidate_order, np.arange(count, len(xy))))[order]
        self._candidate_stations = _StationGrid.of(xy[order], tangent[order], rows.take(order))
        self._support_log.append((np.arange(count, len(xy)), False, len(self._observation_ids) - 1))

    def _merge_candidates(self) -> None:
        """Merge the candidate stations into the main grid, and the observed cells into one set of runs."""
        self._observed_cells = [merge_runs(np.concatenate(self._observed_cells))]
        if not len(self._candidate_stations):
            return
        both = _EvidenceRows.cat(self._merged_stations.rows, self._candidate_stations.rows)
        xy = np.concatenate((self._merged_stations.xy, self._candidate_stations.xy))
        tangent = np.concatenate((self._merged_stations.tangent, self._candidate_stations.tangent))
        order = _order(xy, both.evidence.kind)
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        candidate_place = np.empty(len(self._candidate_stations), np.int64)
        candidate_place[self._candidate_order] = place[len(self._merged_stations) :]
        self._support_log = [
            ((place if main else candidate_place)[rows], True, k) for rows, main, k in self._support_log
        ]
        self._candidate_order = self._candidate_order[:0]
        self._origin = np.concatenate((self._origin, np.full(len(self._candidate_stations), -1, np.int64)))[order]
        self._merged_stations = _StationGrid.of(xy[order], tangent[order], both.take(order))
        self._candidate_stations = _StationGrid.of(np.zeros((0, 2)), np.zeros((0, 2)), both.take(order[:0]))


class _EvidenceRows(NamedTuple):
    """Evidence of stations or rings that observations change in place, without its sources; and the agent that changed each row
    last, the day, and the sum of that agent's changes on that day.
    """

    evidence: EvidenceTable
    last_agent: I64x1
    day: I64x1
    day_sum: F64x1

    @classmethod
    def of(cls, m: VectorMap, rows: Ints) -> _EvidenceRows:
        """Make one row for each of the elements ``rows``."""
        columns = {
            "sigma": m.elements.sigma[m.elements.offsets[:-1][rows]],
            "log_odds": m.log_odds[rows],
            "support": m.supporters[rows],
            "agents": m.agents[rows],
            "state": m.state[rows],
            "t_first": m.t_first[rows],
            "t_last": m.t_last[rows],
            "style": m.elements.style[rows],
        }
        return cls._of(m.elements.kind[rows], -1, 0, columns)

    @classmethod
    def of_points(cls, m: VectorMap, rows: Ints) -> _EvidenceRows:
        """Make one row for each point of the elements ``rows``."""
        _, points = take_rows(m.elements.offsets, rows)
        owner, at_points = m.elements.element_of_point[points], m.point_evidence.take(points)
        columns = {f.name: np.array(getattr(at_points, f.name)) for f in fields(at_points)}
        columns |= {"state": m.state[owner], "style": m.elements.style[owner]}
        return cls._of(m.elements.kind[owner], -1, 0, columns)

    @classmethod
    def _of(cls, kind: Ints, last_agent: int, day: int, columns: dict[str, NDArray]) -> _EvidenceRows:
        """Make rows of these kinds (N,) and columns; the rest is zero."""
        count = len(kind)
        evidence = EvidenceTable.zeros(np.array(kind, np.int64), len(STYLES))._replace(**columns)
        return cls(evidence, np.full(count, last_agent), np.full(count, day), np.zeros(count))

    @classmethod
    def cat(cls, one: _EvidenceRows, two: _EvidenceRows) -> _EvidenceRows:
        """Concatenate two tables, in order."""
        return cls(
            EvidenceTable.cat([one.evidence, two.evidence]),
            np.concatenate((one.last_agent, two.last_agent)),
            np.concatenate((one.day, two.day)),
            np.concatenate((one.day_sum, two.day_sum)),
        )

    def take(self, order: Ints) -> _EvidenceRows:
        """Return the chosen rows, in the order given."""
        return _EvidenceRows(self.evidence.take(order), self.last_agent[order], self.day[order], self.day_sum[order])

    def append_created(
        self, kind: Ints, score_weight: Floats, s: ObservationArrays, config: IncrementalConfig
    ) -> _EvidenceRows:
        """Append rows that an observation creates: their kinds (N,) and the weights of the detections (N,)."""
        evidence, time, count = config.fusion.stations.evidence, int(s.time_ns[0]), len(kind)
        trusted = bool(s.trusted[0])
        limit = evidence.max_log_odds if trusted else evidence.max_daily_change
        odds = np.minimum(evidence.log_odds_hit(trusted) * score_weight, limit)
        may_publish = trusted or evidence.min_publish_agents <= 1
        state = np.where(may_publish & (odds >= evidence.publish_log_odds()[kind, 0]), PUBLISHED, CANDIDATE)
        one = np.ones(count, np.int64)
        columns = {
            "sigma": np.full(count, 0.3),
            "log_odds": odds,
            "support": one,
            "agents": one.copy(),
            "state": state,
            "t_first": one * time,
            "t_last": one * time,
            "style": np.full((count, len(STYLES)), 1.0 / len(STYLES)),
        }
        created = _EvidenceRows._of(kind, _hash_agent(s), time // DAY_NS, columns)
        created.day_sum[:] = odds
        return _EvidenceRows.cat(self, created)

    def add_log_odds(
        self, rows: Ints, log_odds_change: float | Floats, s: ObservationArrays, hit: bool, config: IncrementalConfig
    ) -> None:
        """Add to the log-odds of rows, with decay, daily bound per agent and clamping; then update their state."""
        evidence, time = config.fusion.stations.evidence, int(s.time_ns[0])
        _add_log_odds(
            rows,
            np.broadcast_to(np.asarray(log_odds_change, np.float64), len(rows)),
            self,
            _Update(time, time // DAY_NS, _hash_agent(s), hit, bool(s.trusted[0])),
            _UpdateLimits(
                evidence.max_daily_change,
                evidence.max_log_odds,
                float(evidence.min_publish_agents),
                evidence.retire_log_odds,
                np.array(evidence.decay_time_s),
                evidence.publish_log_odds(),
            ),
        )

    def to_table(self, sources_of_row: Sequence[Sequence[int]], ids: NDArray[np.uint8]) -> EvidenceTable:
        """Convert to the table of the batch fusion; sources_of_row: observations (rows of ids) of each row."""
        sources = [np.unique(np.array(one, np.int64)) for one in sources_of_row]
        table = self.evidence._replace(
            coverage=self.evidence.support.astype(np.float64),
            source_offsets=np.concatenate(([0], np.cumsum([len(one) for one in sources]))).astype(np.int64),
        )
        return table.with_sources(np.concatenate(sources) if sources else np.zeros(0, np.int64), ids)


class _Update(NamedTuple):
    """One observation as an update of rows: time (ns) and day, agent, whether it is a detection, whether it is surveyed."""

    time_ns: int
    day: int
    agent: int
    is_hit: bool
    trusted: bool


class _UpdateLimits(NamedTuple):
    """Bounds of log-odds; decay_s: (4,) by kind, time to 1/e; publish: (4, 4) by kind, log-odds of publication by
    one agent in one view, one, two, or more agents.
    """

    max_daily_change: float
    max_log_odds: float
    min_publish_agents: float
    retire: float
    decay_s: F64x1
    publish: F64x2


@njit(cache=True, nogil=True)
def _add_log_odds(
    rows: I64x1, amount: F64x1, columns: _EvidenceRows, now: _Update, params: _UpdateLimits
) -> None:  # pragma: no cover - compiled
    """Add amount (N,) to the log-odds of rows (N,), decayed, capped by agent and day and clamped; then set their state."""
    evidence, last_agent, day, day_sum = columns
    kind, log_odds, support, agents = evidence.kind, evidence.log_odds, evidence.support, evidence.agents
    state, t_last = evidence.state, evidence.t_last
    time, today, agent, hit, trusted = now
    max_daily_change, max_log_odds, min_agents, retire, decay_time_s, publish = params
    for k, added in zip(rows, amount):
        odds = log_odds[k] * np.exp(-max(0.0, (time - t_last[k]) * 1e-9) / decay_time_s[kind[k]])
        same = last_agent[k] == agent and day[k] == today
        before = day_sum[k] if same else 0.0
        after = before + added
        if not trusted:
            after = min(max(after, -max_daily_change), max_daily_change)
        odds = min(max(odds + after - before, -max_log_odds), max_log_odds)
        log_odds[k], day_sum[k], last_agent[k], day[k] = odds, after, agent, today
        if hit:
            agents[k] += not same
            support[k] += 1
            t_last[k] = max(t_last[k], time)
        if odds <= retire:
            state[k] = RETIRED
        elif hit and odds >= publish[kind[k], min(max(agents[k], 1), 3)] and (trusted or agents[k] >= min_agents):
            state[k] = PUBLISHED


class _PlacedObservation(NamedTuple):
    """One observation at its pose (1, 3) for :func:`_match_stations`; order: rows of its line points among all its points."""

    pose: F64x2
    order: I64x1
    points: _ObservationPoints
    box: _ViewBounds
    visibility_rings: FieldsOfView
    kernel_params: EvidenceParameters

    @classmethod
    def of(
        cls,
        s: ObservationArrays,
        pose: Floats,
        columns: tuple[Floats, Floats, Floats, Floats],
        evidence: EvidenceConfig,
    ) -> _PlacedObservation:
        """Place an observation; columns: positions, tangents, weights and score weights of its points."""
        lines = np.flatnonzero(is_line(s.kind_of_point))
        xy, tangent, weight, score_weight = columns
        fine = build_grid(xy[lines, 0], xy[lines, 1], s.kind_of_point[lines], _CELL_M)
        order, corner = lines[fine.order], s.view_corners_in_world(pose)
        points = _ObservationPoints(
            fine.keys, fine.offsets, xy[order], tangent[order], weight[order], score_weight[order]
        )
        box = _ViewBounds(corner.min(0), corner.max(0))
        return cls(
            np.ascontiguousarray(pose), order, points, box, gather_visibility_rings(s), evidence.to_kernel_params()
        )


@dataclass(eq=False)
class _StationGrid:
    """Stations in the order of their grid, so that the compiled loops read them in place."""

    xy: Floats
    tangent: Floats
    rows: _EvidenceRows
    grid: PointGrid
    observation_of_point: Ints
    weight: Floats

    @classmethod
    def of(cls, xy: Floats, tangent: Floats, rows: _EvidenceRows) -> _StationGrid:
        """Sort stations into a grid; rows: their evidence."""
        xy, tangent = np.ascontiguousarray(xy), np.ascontiguousarray(tangent)
        grid = build_grid(xy[:, 0], xy[:, 1], rows.evidence.kind, _CELL_M)
        no_observation = np.full(len(xy), _NO_OBSERVATION, np.int64)
        weight = np.minimum(4.0, rows.evidence.support.astype(np.float64))
        return cls(xy, tangent, rows, grid, no_observation, weight)

    @cached_property
    def coarse_grid(self) -> DrawnPoints:
        """The stations for the coarse search, at their positions when this was first read."""
        grid = build_grid(self.xy[:, 0], self.xy[:, 1], self.rows.evidence.kind, 8.0)
        heading = count_half_turns(self.tangent[grid.order])
        return DrawnPoints(grid.keys, grid.offsets, self.xy[grid.order], heading, self.observation_of_point)

    def __len__(self) -> int:
        return len(self.xy)

    def update(
        self, s: ObservationArrays, placed: _PlacedObservation, config: IncrementalConfig
    ) -> tuple[Ints, int, NDArray[np.bool_]]:
        """Add the evidence of one observation: rows confirmed, number of rows missed, and which of its points (P,) match a
        station.
        """
        evidence, explained_points = config.fusion.stations.evidence, np.zeros(len(s.xy), bool)
        if not len(self) or not len(explained_points):
            return np.zeros(0, np.int64), 0, explained_points
        near, place, mass, seen, score_weight, explained = _match_stations(
            _GridStations(self.grid.keys, self.grid.offsets, self.xy, self.tangent),
            placed,
            len(KINDS),
        )
        hit = mass > 0.0
        rows = near[hit]
        gain = mass[hit] / (mass[hit] + 1.0 / np.maximum(self.rows.evidence.sigma[rows], 0.02) ** 2 * POINT_VARIANCE_M2)
        self.rows.add_log_odds(rows, evidence.log_odds_hit(bool(s.trusted[0])) * score_weight[hit], s, True, config)
        normal = np.stack((-self.tangent[rows, 1], self.tangent[rows, 0]), 1)
        self.xy[rows] += (gain * place[hit])[:, None] * normal
        self.rows.evidence.sigma[rows] = np.maximum(
            evidence.bias_sigma_m, self.rows.evidence.sigma[rows] * np.sqrt(1.0 - gain)
        )
        missed = (mass < 0.0) & (seen > 0.0)
        self.rows.add_log_odds(near[missed], evidence.log_odds_miss * seen[missed], s, False, config)
        explained_points[placed.order] = explained
        return rows, int(missed.sum()), explained_points


class _GridStations(NamedTuple):
    """Stations in the order of their grid of _CELL_M: its keys and offsets, positions (K, 2) and unit tangents (K, 2)."""

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2


class _ObservationPoints(NamedTuple):
    """Points of one observation's lines in the order of their grid of _CELL_M: its keys and offsets, positions and unit
    tangents (P, 2) in the map's frame, weights (P,) and detection weights (P,).
    """

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2
    weight: F64x1
    score_weight: F64x1


class _ViewBounds(NamedTuple):
    """The lower and the upper corner (2,) of a box, metres in the map's frame."""

    low: F64x1
    high: F64x1


class _ComparedStations(NamedTuple):
    """N stations that one observation covers or detects: rows; lateral offset (m) of its line; weight of that, -1: no line;
    visibility; detection weight. explained: (P,) which of its points, in the order of their grid, match a station.
    """

    rows: I64x1
    offset: F64x1
    weight: F64x1
    visibility: F64x1
    score_weight: F64x1
    explained: Boolx1


class _StationMatch(NamedTuple):
    """Sums over the points that match a station, each with its weight: of weights; of lateral offset (m), point weight and
    detection weight times weight. is_near: whether any line is within the wider gate.
    """

    weight: float
    offset: float
    mass: float
    score_weight: float
    is_near: bool


@njit(cache=True, nogil=True)
def _match_station(
    k: int,
    kind: int,
    stations: _GridStations,
    points: _ObservationPoints,
    params: EvidenceParameters,
    explained: Boolx1,
) -> _StationMatch:  # pragma: no cover - compiled
    """Match station k with the points of its kind; marks those that match in ``explained``."""
    reach, across, wide = params.max_longitudinal_m, params.max_lateral_m, params.max_nearby_m
    radius = np.hypot(reach, wide)
    x, y, u, v = stations.xy[k, 0], stations.xy[k, 1], stations.tangent[k, 0], stations.tangent[k, 1]
    total, offset, heavy, certain, is_near = 0.0, 0.0, 0.0, 0.0, False
    lowest, highest = int(np.floor((y - radius) / _CELL_M)), int(np.floor((y + radius) / _CELL_M))
    for ix in range(int(np.floor((x - radius) / _CELL_M)), int(np.floor((x + radius) / _CELL_M)) + 1):
        low, high = find_cell_range(points.keys, points.start, kind, ix, lowest, highest)
        for q in range(low, high):
            ex, ey = points.xy[q, 0] - x, points.xy[q, 1] - y
            if ex * ex + ey * ey > radius * radius:
                continue
            along, aside = line_residual(ex, ey, u, v, points.tangent[q, 0], points.tangent[q, 1], params.min_cosine)
            along = abs(along)
            if along > reach or abs(aside) > wide:
                continue
            is_near = True
            if abs(aside) <= across:
                explained[q] = True
                w = (1.0 - along / reach) ** 2 + 1e-9
                total += w
                offset += w * aside
                heavy += w * points.weight[q]
                certain += w * points.score_weight[q]
    return _StationMatch(total, offset, heavy, certain, is_near)


@njit(cache=True, nogil=True)
def _match_stations(
    stations: _GridStations, placed: _PlacedObservation, kinds: int
) -> _ComparedStations:  # pragma: no cover - compiled
    """Match the stations in the box of a view with the observed points; those with a line only at a small lateral offset are
    left out.
    """
    params, (low, high) = placed.kernel_params, placed.box
    explained = np.zeros(len(placed.points.xy), np.bool_)
    size, n = 1024, 0
    rows, place, mass = np.empty(size, np.int64), np.empty(size), np.empty(size)
    seen, score_weight = np.empty(size), np.empty(size)
    spot = np.empty((1, 2))
    for kind in range(kinds):
        if kind == CROSSING:
            continue
        for ix in range(int(np.floor((low[0] - 2.0) / _CELL_M)), int(np.floor((high[0] + 2.0) / _CELL_M)) + 1):
            first, last = find_cell_range(
                stations.keys,
                stations.start,
                kind,
                ix,
                int(np.floor((low[1] - 2.0) / _CELL_M)),
                int(np.floor((high[1] + 2.0) / _CELL_M)),
            )
            for k in range(first, last):
                match = _match_station(k, kind, stations, placed.points, params, explained)
                total, is_near = match.weight, match.is_near
                spot[0, 0], spot[0, 1] = stations.xy[k]
                visible = (
                    compute_mean_visibility(spot, 0, placed.pose, placed.visibility_rings, params.margin_m)
                    if not is_near
                    else 1.0
                )
                if total <= 0.0 and (is_near or visible <= 0.0):
                    continue
                if n == size:
                    size *= 2
                    rows, place = doubled(rows), _resize(place, size)
                    mass, seen, score_weight = _resize(mass, size), _resize(seen, size), _resize(score_weight, size)
                rows[n], seen[n], score_weight[n] = k, visible, match.score_weight / total if total > 0.0 else 0.0
                place[n], mass[n] = (match.offset / total, match.mass / total) if total > 0.0 else (0.0, -1.0)
                n += 1
    return _ComparedStations(
        rows[:n].copy(), place[:n].copy(), mass[:n].copy(), seen[:n].copy(), score_weight[:n].copy(), explained
    )


@njit(cache=True, nogil=True)
def _resize(values: F64x1, size: int) -> F64x1:  # pragma: no cover - compiled
    """Copy values to the start of an array of another size."""
    out = np.empty(size)
    set_row(out[: len(values)], values)
    return out


def compute_map_fscore(one: VectorMap, two: VectorMap, threshold_m: float = 0.5) -> float:
    """Compute the F-score of the published lines of two maps: the harmonic mean of the fractions of points of each that lie
    within a distance of the other's lines of the same kind.
    """
    fractions = []
    for a, b in ((one.select_published(), two.select_published()), (two.select_published(), one.select_published())):
        close, total = 0, 0
        kind = a.elements.kind[a.elements.element_of_point]
        for k in np.flatnonzero(is_line(np.arange(len(KINDS)))).tolist():
            others = b.elements.take(np.flatnonzero(b.elements.kind == k))
            points = a.elements.points[kind == k]
            away = find_nearest_line(points, others.points, others.offsets, threshold_m).distance
            close, total = close + int((away <= threshold_m).sum()), total + len(points)
        fractions.append(close / total if total else 1.0)
    return 2 * fractions[0] * fractions[1] / (fractions[0] + fractions[1]) if sum(fractions) > 0 else 0.0


def _points_and_tangents(elements: MapElements) -> tuple[Floats, Floats]:
    """Compute points and unit tangents (P, 2): the chord over both neighbours."""
    points = np.array(elements.points)
    index = np.arange(len(points))
    first, last = elements.offsets[:-1][elements.element_of_point], elements.offsets[1:][elements.element_of_point] - 1
    step = points[np.minimum(index + 1, last)] - points[np.maximum(index - 1, first)]
    return points, step / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-12)[:, None]


def _order(xy: Floats, kind: Ints) -> Ints:
    """Return the order of points in their grid."""
    return build_grid(xy[:, 0], xy[:, 1], kind, _CELL_M).order


def _hash_agent(s: ObservationArrays) -> int:
    """Hash the agent's name to an integer that is the same in every process."""
    return int.from_bytes(s.agents[int(s.agent[0])].encode()[-7:], "little")
