# SPDX-License-Identifier: Apache-2.0
"""Existence probability of map stations as log-odds, updated by detections and misses in order of time.

A station gains log(P_D / P_FA) for an observation that has a line at it, times a weight from the detection score. It loses
visibility times log((1 - P_FA) / (1 - P_D)) for an observation that covers it without a line. A line at a small lateral offset
counts as neither. The change per agent and day is bounded, so that no single agent decides. A surveyed pole is an exception: it
has a lower P_FA, no bound per day, and its detection alone can publish a station. States change with hysteresis.
Misses before the first detection count too, but only down to ``-max_log_odds_before_detection``: one detection after many
misses is more likely false than new, while a few detections that agree still suffice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, I64x2, U8x2, add_row, njit, set_row
from manyeyes.datatypes.map_element import DIVIDER, KINDS, take_rows
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, RETIRED
from manyeyes.maps.fusion.existence_calibration import CROSSING_PROB, LINE_PROB, MIN_VIEWS, find_log_odds
from manyeyes.maps.fusion.observation_arrays import DAY_NS, FieldsOfView, ObservationArrays, compute_visibility, is_line
from manyeyes.maps.fusion.point_grid import build_grid, find_cell_range, line_residual, lower_bound

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_VIEW_CELL_M = 32.0
_POINT_CELL_M = 2.5
_DAY_S = 86400.0
POINT_VARIANCE_M2 = 0.04
"""Lateral variance of a point of weight 1, metres squared."""

# Relation of an observation to a station: no line, a line within the gates, or one at a small lateral offset.
UNMATCHED, MATCHED, NEARBY = 0, 1, 2


class EvidenceParameters(NamedTuple):
    """The values of EvidenceConfig as compiled loops read them; metres; min_cosine: cosine of the heading gate.

    hit, trusted_hit, miss: change of log-odds. max_log_odds: bound of their absolute value; max_initial_log_odds: before the first
    detection. publish_one_view, publish_one, publish_two, publish_many: log-odds of publication by one agent in one view, one, two,
    and more agents. min_publish_agents, min_retire_agents: distinct agents.
    """

    hit: float
    trusted_hit: float
    miss: float
    max_log_odds: float
    max_daily_change: float
    publish_one_view: float
    publish_one: float
    publish_two: float
    publish_many: float
    retire: float
    margin_m: float
    max_longitudinal_m: float
    max_lateral_m: float
    max_nearby_m: float
    min_cosine: float
    kernel_m: float
    bias_m: float
    max_initial_log_odds: float
    min_publish_agents: int
    min_retire_agents: int


@dataclass(frozen=True)
class EvidenceConfig:
    """Detection model and thresholds of the existence estimate.

    detection_prob, false_alarm_prob: P_D and P_FA. trusted_false_alarm_prob: P_FA of a surveyed pole, whose one detection of full
        weight exceeds the thresholds of publication; on Town07 5 % of such detections with scores from 0.5 are false.
    max_log_odds: bound of |log-odds|; max_log_odds_before_detection: bound of negative log-odds before the first detection.
    max_daily_change: bound of the change by one agent in a day.
    score_low, score_high: scores at which a detection has weight 0 and 1; linear in between.
    min_publish_prob: calibrated probability (``existence_calibration``) from which a station of a line or a crossing is published,
        given min_publish_agents agents or a surveyed pole.
    retire_log_odds: threshold of retirement, given misses by min_retire_agents agents.
    view_margin_m: distance from the border of a view within which a miss counts less.
    decay_time_s: by kind, time in which log-odds decay to 1/e.
    max_longitudinal_m, max_lateral_m, max_heading_rad: gates of a detection; max_ambiguous_lateral_m: lateral gate beyond which
        a line has no influence.
    kernel_m: Geman-McClure scale of the lateral position; bias_sigma_m: standard deviation that averaging does not reduce.
    """

    detection_prob: float = 0.7
    false_alarm_prob: float = 0.15
    trusted_false_alarm_prob: float = 0.05
    max_log_odds: float = 6.0
    max_log_odds_before_detection: float = 2.0
    max_daily_change: float = 2.0
    score_low: float = 0.4
    score_high: float = 0.7
    min_publish_prob: float = 0.7
    min_publish_agents: int = 1
    retire_log_odds: float = -1.4
    min_retire_agents: int = 3
    view_margin_m: float = 2.0
    decay_time_s: tuple[float, float, float, float] = (180 * _DAY_S, 180 * _DAY_S, 365 * _DAY_S, 180 * _DAY_S)
    max_longitudinal_m: float = 1.5
    max_lateral_m: float = 0.9
    max_ambiguous_lateral_m: float = 1.2
    max_heading_rad: float = 0.35
    kernel_m: float = 0.5
    bias_sigma_m: float = 0.05

    def log_odds_hit(self, trusted: bool = False) -> float:
        """Return the change of log-odds by a detection of full weight; trusted: of a surveyed pole."""
        return float(
            np.log(self.detection_prob / (self.trusted_false_alarm_prob if trusted else self.false_alarm_prob))
        )

    def score_weight(self, score: Floats) -> Floats:
        """Compute the weight (E,) in [0, 1] of detections with these scores."""
        return np.clip((np.asarray(score) - self.score_low) / (self.score_high - self.score_low), 0.0, 1.0)

    def publish_log_odds(self) -> Floats:
        """Return the log-odds (4, 4) by kind from which an element is published, for each row of its table."""
        tables = [LINE_PROB if line else CROSSING_PROB for line in is_line(np.arange(len(KINDS)))]
        return np.array([[find_log_odds(row, self.min_publish_prob) for row in table] for table in tables])

    @property
    def log_odds_miss(self) -> float:
        """The change of log-odds by a miss in full visibility; negative."""
        return float(np.log((1 - self.detection_prob) / (1 - self.false_alarm_prob)))

    def to_kernel_params(self, kind: int = DIVIDER) -> EvidenceParameters:
        """Return the configuration as compiled loops read it, with the thresholds of a kind; those of all lines are the same."""
        publish_one_view, publish_one, publish_two, publish_many = self.publish_log_odds()[kind].tolist()
        return EvidenceParameters(
            hit=self.log_odds_hit(),
            trusted_hit=self.log_odds_hit(trusted=True),
            miss=self.log_odds_miss,
            max_log_odds=float(self.max_log_odds),
            max_daily_change=float(self.max_daily_change),
            publish_one_view=publish_one_view,
            publish_one=publish_one,
            publish_two=publish_two,
            publish_many=publish_many,
            retire=float(self.retire_log_odds),
            margin_m=float(self.view_margin_m),
            max_longitudinal_m=float(self.max_longitudinal_m),
            max_lateral_m=float(self.max_lateral_m),
            max_nearby_m=float(self.max_ambiguous_lateral_m),
            min_cosine=float(np.cos(self.max_heading_rad)),
            kernel_m=float(self.kernel_m),
            bias_m=float(self.bias_sigma_m),
            max_initial_log_odds=float(self.max_log_odds_before_detection),
            min_publish_agents=self.min_publish_agents,
            min_retire_agents=self.min_retire_agents,
        )


class VisibilityIndex(NamedTuple):
    """Observations that may cover a place: rows ``observations[offsets[c]:offsets[c + 1]]``, in time order, for cell
    ``keys[c]``.
    """

    keys: I64x1
    offsets: I64x1
    observations: I64x1


class Observers(NamedTuple):
    """O observations at their corrected poses: pose (O, 3) x, y (m), yaw (rad); agent, time_ns and trusted (O,).

    num_agents: number of agents; ``agent`` counts in them.
    """

    pose: F64x2
    agent: I64x1
    time_ns: I64x1
    trusted: Boolx1
    num_agents: int


class ObservationScene(NamedTuple):
    """Everything that determines visibility: the index of observations by cell, their poses, views and occluders."""

    cells: VisibilityIndex
    observers: Observers
    fields: FieldsOfView


class ElementStyles(NamedTuple):
    """Style probabilities (E, S) of E observed elements and the weights (E,) of their detections."""

    style: F64x2
    score_weight: F64x1


class AgentScratch(NamedTuple):
    """Scratch of :func:`update_existence` by agent (A,): sum of log-odds of the day, whether it has detected the element, the
    element (index + 1) and day of that sum, and the eras in which it last counted as a detection and as a miss.
    """

    day_sum: F64x1
    has_seen: Boolx1
    thing: I64x1
    day: I64x1
    seen_era: I64x1
    missed_era: I64x1


class MatchedObservations(NamedTuple):
    """Detections of one element: rows of the observations, ascending; of all observations (O,) UNMATCHED, MATCHED or NEARBY,
    and the weight of each detection.
    """

    rows: I64x1
    match: I64x1
    score_weight: F64x1


class ExistenceEstimate(NamedTuple):
    """Existence of one element: log-odds, sum of visibilities, number of distinct agents that detected it, and its state."""

    log_odds: float
    coverage: float
    num_agents: int
    state: int


class EvidenceTable(NamedTuple):
    """The evidence of K elements: stations of lines, or crossings.

    kind: (K,) index into KINDS. sigma: (K,) metres, of the lateral position. log_odds, coverage: (K,), coverage being the sum of
    visibilities. support, agents: (K,) observations and distinct agents that detected it. state: (K,). t_first, t_last: (K,) ns.
    style: (K, S) votes. Element k was detected by observations ``sources[source_offsets[k]:source_offsets[k + 1]]``, ascending
    rows of observations, which are ids (U, 16), ascending.
    """

    kind: I64x1
    sigma: F64x1
    log_odds: F64x1
    coverage: F64x1
    support: I64x1
    agents: I64x1
    state: I64x1
    t_first: I64x1
    t_last: I64x1
    style: F64x2
    source_offsets: I64x1
    sources: I64x1
    observations: U8x2

    @classmethod
    def zeros(cls, kind: Ints, num_styles: int) -> EvidenceTable:
        """Make rows of these kinds without evidence."""
        count = len(kind)
        sigma, log_odds, coverage = (np.zeros(count) for _ in range(3))
        support, agents, state, t_first, t_last = (np.zeros(count, np.int64) for _ in range(5))
        style, offsets, none = np.zeros((count, num_styles)), np.zeros(count + 1, np.int64), np.zeros(0, np.int64)
        ids = np.zeros((0, 16), np.uint8)
        return cls(kind, sigma, log_odds, coverage, support, agents, state, t_first, t_last, style, offsets, none, ids)

    def with_sources(self, sources: Ints, ids: NDArray[np.uint8]) -> EvidenceTable:
        """Return the same with sources, rows of ids (O, 16) in any order, in the order of source_offsets."""
        observations, place = np.unique(ids, axis=0, return_inverse=True)
        sources = place.reshape(-1)[sources]
        owner = np.repeat(np.arange(len(self.kind)), np.diff(self.source_offsets))
        return self._replace(sources=sources[np.lexsort((sources, owner))], observations=observations)

    def take(self, rows: Ints) -> EvidenceTable:
        """Return the chosen rows, in the order given."""
        first, places = take_rows(self.source_offsets, rows)
        columns = {name: getattr(self, name).take(rows, 0) for name in self._fields[:-3]}
        return self._replace(source_offsets=first, sources=self.sources[places], **columns)

    @classmethod
    def cat(cls, tables: Sequence[EvidenceTable]) -> EvidenceTable:
        """Concatenate tables, in order, and merge their observations."""
        observations, place = np.unique(np.concatenate([e.observations for e in tables]), axis=0, return_inverse=True)
        seen = np.cumsum([0, *(len(e.observations) for e in tables)])
        counts = np.concatenate([np.diff(e.source_offsets) for e in tables])
        return tables[0]._replace(
            source_offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
            sources=np.concatenate([place.reshape(-1)[start + e.sources] for e, start in zip(tables, seen)]),
            observations=observations,
            **{name: np.concatenate([getattr(e, name) for e in tables]) for name in cls._fields[:-3]},
        )


def build_visibility_index(
    arrays: ObservationArrays, pose: Floats, included: NDArray[np.bool_] | None = None
) -> VisibilityIndex:
    """Index the observations by the cells of 32 m that their views' boxes meet, with agents at pose (O, 3).

    included: (O,) observations in the index; None: all.
    """
    xy, ring_offsets, observation_offsets = arrays.view.xy, arrays.view.ring_offsets, arrays.view.observation_offsets
    owner = np.repeat(
        np.repeat(np.arange(len(observation_offsets) - 1), np.diff(observation_offsets)), np.diff(ring_offsets)
    )
    c, s = np.cos(pose[owner, 2]), np.sin(pose[owner, 2])
    placed = np.stack((c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]), 1) + pose[owner, :2]
    low, high = np.full((len(pose), 2), np.inf), np.full((len(pose), 2), -np.inf)
    np.minimum.at(low, owner, placed)
    np.maximum.at(high, owner, placed)
    cell, observer = _cells(
        np.floor(low / _VIEW_CELL_M).astype(np.int64), np.floor(high / _VIEW_CELL_M).astype(np.int64)
    )
    if included is not None:
        cell, observer = cell[included[observer]], observer[included[observer]]
    order = np.lexsort((observer, cell))
    keys, start = np.unique(cell[order], return_index=True)
    return VisibilityIndex(keys, np.append(start, len(order)).astype(np.int64), observer[order])


@njit(cache=True, nogil=True)
def _cells(low: I64x2, high: I64x2) -> tuple[I64x1, I64x1]:  # pragma: no cover - compiled
    """List the keys of the cells from low to high (O, 2) of each observation, and the observation of each key."""
    total = 0
    for o in range(len(low)):
        total += (high[o, 0] - low[o, 0] + 1) * (high[o, 1] - low[o, 1] + 1)
    cell, observer = np.empty(total, np.int64), np.empty(total, np.int64)
    k = 0
    for o in range(len(low)):
        for ix in range(low[o, 0], high[o, 0] + 1):
            for iy in range(low[o, 1], high[o, 1] + 1):
                cell[k] = ((ix + 536870912) << 30) | (iy + 536870912)
                observer[k] = o
                k += 1
    return cell, observer


def gather_observers(observation_arrays: ObservationArrays, pose: Floats) -> Observers:
    """Gather the observations at pose (O, 3) for the compiled loops."""
    arrays = (
        np.asarray(observation_arrays.agent),
        np.asarray(observation_arrays.time_ns),
        np.asarray(observation_arrays.trusted),
    )
    return Observers(np.ascontiguousarray(pose), *arrays, len(observation_arrays.agents))


def gather_visibility_rings(arrays: ObservationArrays) -> FieldsOfView:
    """Gather views and occluders for the compiled loops."""
    return FieldsOfView(arrays.view, arrays.occluders)


def accumulate_evidence(
    xy: Floats,
    tangent: Floats,
    kind: Ints,
    arrays: ObservationArrays,
    pose: Floats,
    weight: Floats,
    is_inlier: NDArray[np.bool_],
    common_covariance: Floats,
    config: EvidenceConfig = EvidenceConfig(),
) -> tuple[Floats, EvidenceTable]:
    """Accumulate the evidence for line stations (K,) at xy with unit tangents from all observations, with agents at pose (O,
    3): metres (K,) along the normal to the position that the observations agree on, and the evidence.

    weight: (P,) weight of each point in the lateral position, POINT_VARIANCE_M2 over its variance; points of weight 0 are no
    detections. A detection counts once per observation. is_inlier: (O,) observations whose misses count. common_covariance:
    (O, 3, 3) of the poses, what observations of one place share, which averaging does not reduce.
    """
    points = np.flatnonzero(is_line(arrays.kind_of_point) & (weight > 0.0))
    world, direction = arrays.to_world(pose)
    grid = build_grid(world[points, 0], world[points, 1], arrays.kind_of_point[points], _POINT_CELL_M)
    order = points[grid.order]
    index = build_visibility_index(arrays, pose, is_inlier)
    others = _EvidencePoints(
        grid.keys,
        grid.offsets,
        world.take(order, 0),
        direction.take(order, 0),
        arrays.observation_of_point[order],
        arrays.element_of_point[order],
        weight[order],
    )
    styles = ElementStyles(np.asarray(arrays.elements.style), config.score_weight(arrays.elements.score))
    evidence = EvidenceTable.zeros(kind, styles.style.shape[1])
    shift, sources = _accumulate_evidence(
        _EvidenceStations(xy, tangent, kind),
        others,
        ObservationScene(index, gather_observers(arrays, pose), gather_visibility_rings(arrays)),
        styles,
        config.to_kernel_params(),
        np.array(config.decay_time_s),
        evidence,
    )
    common = _compute_common_variance(xy, tangent, evidence.source_offsets, sources, pose, common_covariance)
    evidence = evidence._replace(sigma=np.sqrt(evidence.sigma**2 + common))
    return shift, evidence.with_sources(sources, arrays.digests)


def _compute_common_variance(
    xy: Floats, tangent: Floats, offsets: Ints, sources: Ints, pose: Floats, common_covariance: Floats
) -> Floats:
    """Compute the lateral variance (K,) at stations by the common covariance of the poses of their sources, mean over them."""
    count = np.diff(offsets)
    station = np.repeat(np.arange(len(count)), count)
    variance = compute_lateral_variance(
        xy.take(station, 0), tangent.take(station, 0), pose.take(sources, 0), common_covariance.take(sources, 0)
    )
    return np.bincount(station, variance.clip(0.0), len(count)) / np.maximum(1, count)


def compute_lateral_variance(xy: Floats, tangent: Floats, pose: Floats, covariance: Floats) -> Floats:
    """Compute the variance (N,) across a line at xy with unit tangents (N, 2) by the covariance (N, 3, 3) of a pose (N, 3), m²."""
    lever = xy - pose[:, :2]
    normal = np.stack((-tangent[:, 1], tangent[:, 0]), 1)
    jacobian = np.concatenate((normal, (normal[:, 1] * lever[:, 0] - normal[:, 0] * lever[:, 1])[:, None]), 1)
    return np.einsum("ni,nij,nj->n", jacobian, covariance, jacobian)


class _EvidenceStations(NamedTuple):
    """Stations of lines: positions (K, 2), unit tangents (K, 2) and kinds (K,)."""

    xy: F64x2
    tangent: F64x2
    kind: I64x1


class _EvidencePoints(NamedTuple):
    """Points of observed lines in the order of their grid of _POINT_CELL_M: its keys and offsets, positions and unit tangents
    (P, 2) in the map's frame, rows of observations and elements, and weights (P,).
    """

    keys: I64x1
    start: I64x1
    xy: F64x2
    tangent: F64x2
    observation: I64x1
    element: I64x1
    weight: F64x1


class _MatchScratch(NamedTuple):
    """Match of each observation (O,) at one station: sums over its points of weight, of weight times lateral offset and of
    weight times weight of the point; smallest longitudinal distance and the element there; UNMATCHED, MATCHED or NEARBY.

    candidates: the observations that are not UNMATCHED, as many as :func:`_collect_offsets` returns.
    """

    mass: F64x1
    offset: F64x1
    pull: F64x1
    nearest: F64x1
    element: I64x1
    match: I64x1
    candidates: I64x1


@njit(cache=True, nogil=True)
def new_agent_scratch(count: int) -> AgentScratch:  # pragma: no cover - compiled
    """Make the scratch of count agents."""
    return AgentScratch(
        np.zeros(count),
        np.zeros(count, np.bool_),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
    )


@njit(cache=True, nogil=True)
def doubled(rows: I64x1) -> I64x1:  # pragma: no cover - compiled
    """Return the same rows at the start of an array of twice the length."""
    bigger = np.empty(2 * len(rows), np.int64)
    set_row(bigger[: len(rows)], rows)
    return bigger


@njit(cache=True, nogil=True)
def _accumulate_evidence(
    stations: _EvidenceStations,
    points: _EvidencePoints,
    scene: ObservationScene,
    element_columns: ElementStyles,
    params: EvidenceParameters,
    decay_time_s: F64x1,
    out: EvidenceTable,
) -> tuple[F64x1, I64x1]:  # pragma: no cover - compiled
    """Write the evidence of each station to ``out``; returns the lateral shifts and the sources. decay_time_s: (4,) by kind."""
    xy, tangent, kind = stations
    style, score_weight = element_columns
    time_ns = scene.observers.time_ns
    count, observations = len(xy), len(time_ns)
    shift, first = np.zeros(count), out.source_offsets
    sources, filled = np.empty(max(16, 8 * count), np.int64), 0
    mass, offset, pull = np.zeros(observations), np.zeros(observations), np.zeros(observations)
    nearest, element, gain = np.zeros(observations), np.zeros(observations, np.int64), np.zeros(observations)
    lateral_state = np.full(observations, UNMATCHED, np.int64)
    candidates, place = np.empty(observations, np.int64), np.empty((1, 2))
    scratch = _MatchScratch(mass, offset, pull, nearest, element, lateral_state, candidates)
    by_agent = new_agent_scratch(scene.observers.num_agents)
    for k in range(count):
        n = _collect_offsets(k, stations, points, params, scratch)
        # Sums over observations go in their order, whatever order the grid gave.
        candidates[:n].sort()
        shift[k], out.sigma[k] = _estimate_shift(n, scratch, params)
        for t in range(n):
            o = candidates[t]
            if lateral_state[o] == MATCHED and abs(offset[o] / mass[o] - shift[k]) > params.max_lateral_m:
                lateral_state[o] = NEARBY
        # The gate is relative to the shift, which is known only now.
        for t in range(n):
            o = candidates[t]
            if lateral_state[o] == MATCHED:
                if filled == len(sources):
                    sources = doubled(sources)
                sources[filled] = o
                filled += 1
                add_row(out.style[k], style[element[o]])
                gain[o] = score_weight[element[o]]
        first[k + 1] = filled
        place[0, 0], place[0, 1] = xy[k, 0] - shift[k] * tangent[k, 1], xy[k, 1] + shift[k] * tangent[k, 0]
        hits = MatchedObservations(sources[first[k] : filled], lateral_state, gain)
        out.log_odds[k], out.coverage[k], out.agents[k], out.state[k] = update_existence(
            place, k, hits, scene, params, float(decay_time_s[kind[k]]), by_agent
        )
        out.support[k] = filled - first[k]
        if out.support[k] > 0:
            out.t_first[k], out.t_last[k] = time_ns[sources[first[k]]], time_ns[sources[filled - 1]]
        for t in range(n):
            o = candidates[t]
            mass[o], offset[o], pull[o], lateral_state[o] = 0.0, 0.0, 0.0, UNMATCHED
    return shift, sources[:filled].copy()


@njit(cache=True, nogil=True)
def _collect_offsets(
    k: int, stations: _EvidenceStations, points: _EvidencePoints, params: EvidenceParameters, scratch: _MatchScratch
) -> int:  # pragma: no cover - compiled
    """Average each observation's lateral offset at station k over its points nearby; returns the number of such observations."""
    xy, tangent, kind = stations
    keys, start, rxy, rtangent, robservation, relement, rweight = points
    mass, offset, pull, nearest, element, lateral_state, candidates = scratch
    reach, across, wide = params.max_longitudinal_m, params.max_lateral_m, params.max_nearby_m
    x, y, u, v = xy[k, 0], xy[k, 1], tangent[k, 0], tangent[k, 1]
    ix, iy = int(np.floor(x / _POINT_CELL_M)), int(np.floor(y / _POINT_CELL_M))
    n = 0
    for dx in range(-1, 2):
        low, high = find_cell_range(keys, start, kind[k], ix + dx, iy - 1, iy + 1)
        for q in range(low, high):
            ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
            if ex * ex + ey * ey > reach * reach + wide * wide:
                continue
            along, aside = line_residual(ex, ey, u, v, rtangent[q, 0], rtangent[q, 1], params.min_cosine)
            along = abs(along)
            if along > reach or abs(aside) > wide:
                continue
            o = robservation[q]
            if lateral_state[o] == UNMATCHED:
                candidates[n] = o
                n += 1
                lateral_state[o] = NEARBY
                nearest[o] = np.inf
            if abs(aside) > across:
                continue
            lateral_state[o] = MATCHED
            # Weights fall steeply with distance, so that the two nearest points interpolate.
            w = (1.0 - along / reach) ** 2 + 1e-9
            mass[o] += w
            offset[o] += w * aside
            pull[o] += w * rweight[q]
            if along < nearest[o]:
                nearest[o] = along
                element[o] = relement[q]
    return n


@njit(cache=True, nogil=True)
def _estimate_shift(
    n: int, scratch: _MatchScratch, params: EvidenceParameters
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Estimate the lateral position that the observations agree on, and its sigma, by iteratively reweighted means.

    Each observation contributes once.
    """
    mass, offset, pull, lateral_state, candidates = (
        scratch.mass,
        scratch.offset,
        scratch.pull,
        scratch.match,
        scratch.candidates,
    )
    kernel, floor = params.kernel_m, params.bias_m
    place, spread = 0.0, kernel
    for turn in range(4):
        total, aside, information = 0.0, 0.0, 0.0
        # The kernel narrows after the first iteration, so that the result depends little on the start.
        c2 = (kernel * (2.0 if turn == 0 else 1.0)) ** 2
        for i in range(n):
            o = candidates[i]
            if lateral_state[o] == MATCHED:
                d = offset[o] / mass[o]
                g = c2 / (c2 + (d - place) ** 2)
                w = pull[o] / mass[o] * g * g
                total += w
                aside += w * d
                information += w * g
        if total <= 0.0:
            return 0.0, float(kernel)
        place = aside / total
        # What lies farther away than the kernel is not of this line, so that its scale bounds the error.
        spread = np.sqrt(1.0 / (information / POINT_VARIANCE_M2 + 1.0 / kernel**2) + floor * floor)
    return float(place), float(spread)


@njit(cache=True, nogil=True)
def update_existence(
    places: F64x2,
    k: int,
    found: MatchedObservations,
    scene: ObservationScene,
    params: EvidenceParameters,
    decay_time_s: float,
    scratch: AgentScratch,
) -> ExistenceEstimate:  # pragma: no cover - compiled
    """Update the existence of element k by all observations that cover it, in time order.

    places: (M, 2) points of the element whose visibilities are averaged. decay_time_s: time in which log-odds decay to 1/e.
    """
    pose, agent, time_ns, trusted, _ = scene.observers
    hits, lateral_state, score_weight = found
    of = scene.cells.observations
    max_log_odds = params.max_log_odds
    low, high = _cell_of(places, scene.cells)
    odds, coverage, state, then, surveyed, started = 0.0, 0.0, CANDIDATE, 0, False, False
    seen_by, all_by, missed_by, next_hit, q, floor = 0, 0, 0, 0, low, -params.max_initial_log_odds
    era_seen, era_missed = 1, 1
    while next_hit < len(hits) or q < high:
        is_hit = next_hit < len(hits) and (q >= high or hits[next_hit] <= of[q])
        if is_hit:
            o, seen = hits[next_hit], 1.0
            next_hit += 1
            if q < high and of[q] == o:
                q += 1
        else:
            o = of[q]
            q += 1
            seen = 0.0
            if lateral_state[o] != NEARBY:
                seen = compute_mean_visibility(places, o, pose, scene.fields, params.margin_m)
        coverage += seen
        if seen <= 0.0:
            continue
        if started:
            odds *= np.exp(-(time_ns[o] - then) * 1e-9 / decay_time_s)
        started, then = True, time_ns[o]
        a = int(agent[o])
        _open_day(scratch, a, k, int(time_ns[o] // DAY_NS))
        hit = params.trusted_hit if trusted[o] else params.hit
        change = hit * score_weight[o] if is_hit else params.miss * seen
        if not trusted[o]:
            change = _bound_daily_change(scratch, a, float(change), params.max_daily_change)
        floor = -max_log_odds if is_hit else floor
        odds = min(max_log_odds, max(floor, odds + change))
        if is_hit:
            seen_by += _count_once(scratch.seen_era, a, era_seen)
            all_by += not scratch.has_seen[a]
            scratch.has_seen[a] = True
            surveyed = surveyed or trusted[o]
        elif all_by > 0:
            missed_by += _count_once(scratch.missed_era, a, era_missed)
        publish = params.publish_two if seen_by == 2 else params.publish_many
        if seen_by <= 1:
            publish = params.publish_one_view if coverage < MIN_VIEWS else params.publish_one
        if odds >= publish and (seen_by >= params.min_publish_agents or surveyed):
            state = PUBLISHED
            era_missed += 1
            missed_by = 0
        elif odds <= params.retire and missed_by >= params.min_retire_agents and state != RETIRED:
            state = RETIRED
            era_seen += 1
            seen_by, surveyed = 0, False
    return ExistenceEstimate(float(odds), coverage, all_by, state)


@njit(cache=True, nogil=True)
def _count_once(eras: I64x1, a: int, era: int) -> int:  # pragma: no cover - compiled
    """Mark agent a as counted in this era; returns 1 if it was not yet, else 0."""
    if eras[a] == era:
        return 0
    eras[a] = era
    return 1


@njit(cache=True, nogil=True)
def _bound_daily_change(
    scratch: AgentScratch, a: int, change: float, max_daily_change: float
) -> float:  # pragma: no cover - compiled
    """Return the part of a change by which the sum of agent a's changes of the day stays within its bound; counts it."""
    allowed = min(max_daily_change, max(-max_daily_change, scratch.day_sum[a] + change))
    change, scratch.day_sum[a] = allowed - scratch.day_sum[a], allowed
    return change


@njit(cache=True, nogil=True)
def _open_day(scratch: AgentScratch, a: int, k: int, day: int) -> None:  # pragma: no cover - compiled
    """Reset the scratch of agent a for another element than k, and its sum for another day."""
    if scratch.thing[a] != k + 1:
        scratch.thing[a], scratch.day[a], scratch.seen_era[a], scratch.missed_era[a] = k + 1, day, 0, 0
        scratch.day_sum[a], scratch.has_seen[a] = 0.0, False
    if scratch.day[a] != day:
        scratch.day[a], scratch.day_sum[a] = day, 0.0


def find_covered_by_inliers(
    arrays: ObservationArrays, pose: Floats, is_inlier: NDArray[np.bool_], min_agents: int, view_margin_m: float
) -> NDArray[np.bool_]:
    """Find the points (P,) of rejected observations that lie in the views of at least ``min_agents`` inlier agents.

    is_inlier: (O,) observations of agents that were not rejected.
    """
    out = np.zeros(len(arrays.xy), np.bool_)
    if not is_inlier.all():
        index = build_visibility_index(arrays, pose, is_inlier)
        rejected = np.flatnonzero(~is_inlier)
        xy = arrays.to_world(pose)[0]
        scene = ObservationScene(index, gather_observers(arrays, pose), gather_visibility_rings(arrays))
        _mark_covered(rejected, np.asarray(arrays.observation_offsets), xy, scene, view_margin_m, min_agents, out)
    return out


@njit(cache=True, nogil=True)
def _mark_covered(
    rejected: I64x1, first: I64x1, xy: F64x2, scene: ObservationScene, margin: float, min_agents: int, out: Boolx1
) -> None:  # pragma: no cover - compiled
    """Mark in out (P,) the points of ``rejected`` observations that at least ``min_agents`` agents of the scene cover."""
    agent, pose, of = scene.observers.agent, scene.observers.pose, scene.cells.observations
    seen, place = np.full(scene.observers.num_agents, -1), np.empty((1, 2))
    for o in rejected:
        for p in range(first[o], first[o + 1]):
            place[0, 0], place[0, 1] = xy[p, 0], xy[p, 1]
            low, high = _cell_of(place, scene.cells)
            count = 0
            for q in range(low, high):
                other = of[q]
                if seen[agent[other]] != p and compute_mean_visibility(place, other, pose, scene.fields, margin) > 0.0:
                    seen[agent[other]] = p
                    count += 1
                    if count == min_agents:
                        out[p] = True
                        break


@njit(cache=True, nogil=True)
def _cell_of(places: F64x2, index: VisibilityIndex) -> tuple[int, int]:  # pragma: no cover - compiled
    """Return the range in ``index.observations`` of the observations that may cover the first place."""
    keys, start, _ = index
    ix, iy = int(np.floor(places[0, 0] / _VIEW_CELL_M)), int(np.floor(places[0, 1] / _VIEW_CELL_M))
    key = ((ix + 536870912) << 30) | (iy + 536870912)
    cell = lower_bound(keys, key)
    if cell < len(keys) and keys[cell] == key:
        return start[cell], start[cell + 1]
    return 0, 0


@njit(cache=True, nogil=True)
def compute_mean_visibility(
    places: F64x2, o: int, pose: F64x2, rings: FieldsOfView, margin: float
) -> float:  # pragma: no cover - compiled
    """Compute the mean visibility of places from observation o; 0 for several places whose mean is below a half."""
    c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
    total = 0.0
    for i in range(len(places)):
        dx, dy = places[i, 0] - pose[o, 0], places[i, 1] - pose[o, 1]
        total += compute_visibility(c * dx + s * dy, -s * dx + c * dy, o, rings.views, rings.occluders, margin)
    mean = total / len(places)
    return mean if len(places) == 1 or mean >= 0.5 else 0.0
