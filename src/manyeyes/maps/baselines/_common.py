# SPDX-License-Identifier: Apache-2.0
"""What all baselines share with this project's own fusion, so that only the merging differs.

Pre-filter: elements below a score, and lines below a length, are left out; duplicate observations count once, and the order of
input has no effect (sorted by time, then id). Poses are the prior poses.

Score: sigmoid(L / 4) min(1, length / full), as in this project's fusion, times the mean score of the merged elements. L is the
mean over places of an element of its log-odds: log(P_D / P_FA) for each merged observation, and v log((1 - P_D) / (1 - P_FA))
for each other observation that covers the place with visibility v; |L| is at most 6.

State: published where L, the number of observations and the length reach the minimum of the rules; else candidate. Cuts: none
here; the evaluation cuts all maps by one policy (lines at junctions).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import CROSSING, MapElements, freeze, take_rows
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, VectorMap
from manyeyes.maps.fusion.observation_arrays import FieldsOfView, ObservationRings, compute_visibility
from manyeyes.ops.polyline import close_rings, find_near_pairs_between, resample_spaced

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DETECTION_PROB, FALSE_ALARM_PROB, MAX_LOG_ODDS = 0.7, 0.15, 6.0
LOG_ODDS_HIT = math.log(DETECTION_PROB / FALSE_ALARM_PROB)
LOG_ODDS_MISS = math.log((1 - DETECTION_PROB) / (1 - FALSE_ALARM_PROB))
_PLACE_M, _MARGIN_M = 2.0, 2.0


@dataclass(frozen=True)
class BaselineRules:
    """The shared rules, by kind (divider, boundary, crossing, stop line) where they are tuples.

    min_score: smallest score of an input element. min_input_length_m: shortest input element.
    min_published_length_m: shortest published element. full_score_length_m: length from which a score is not lowered.
    publish_log_odds, min_observations: smallest log-odds and number of observations of a published element.
    """

    min_score: float = 0.3
    min_input_length_m: tuple[float, float, float, float] = (4.0, 4.0, 0.0, 1.0)
    min_published_length_m: tuple[float, float, float, float] = (8.0, 8.0, 0.0, 2.0)
    full_score_length_m: tuple[float, float, float, float] = (20.0, 20.0, 0.0, 3.0)
    publish_log_odds: float = -MAX_LOG_ODDS
    min_observations: int = 1


@dataclass(frozen=True, eq=False)
class ElementPool:
    """The result of the pre-filter: observations (O), each once, by time; elements (N) in the map's frame; their observation
    (N,).
    """

    observations: tuple[Observation, ...]
    elements: MapElements
    observation_of_element: Ints

    def closed_lines(self) -> tuple[Floats, Ints]:
        """Return points and offsets of the elements with rings closed."""
        return close_rings(self.elements.points, self.elements.offsets, self.elements.closed)

    def sort_by_plausibility(self, row_indices: Ints) -> Ints:
        """Return the rows from the most plausible on: by score, then length, then least corner."""
        low = self.elements.bounds()[row_indices]
        length = np.round(self.elements.lengths()[row_indices], 6)
        return row_indices[np.lexsort((low[:, 1], low[:, 0], -length, -self.elements.score[row_indices]))]


@dataclass(frozen=True, eq=False)
class MergedElement:
    """A merged element: its points (K, 2), rings open; its kind; and the rows of the pool that it was made of."""

    points: Floats
    kind: int
    source_rows: Ints


def filter_elements(observations: Sequence[Observation], rules: BaselineRules) -> ElementPool:
    """Return the observations after the pre-filter, in one order."""
    unique = {o.id: o for o in observations}
    chosen = tuple(sorted(unique.values(), key=lambda o: (o.time_ns, o.id)))
    elements = MapElements.cat([o.elements_in_map() for o in chosen])
    owner = np.repeat(np.arange(len(chosen)), [len(o.elements) for o in chosen]).astype(np.int64)
    stays = (elements.score >= rules.min_score) & (
        elements.lengths() >= np.array(rules.min_input_length_m)[elements.kind]
    )
    return ElementPool(chosen, elements.take(stays), owner[stays])


def to_vector_map(
    pool: ElementPool, merged: Sequence[MergedElement], rules: BaselineRules, frame: MapFrame | None
) -> VectorMap:
    """Return the merged elements as a map in canonical order, with the shared score and state."""
    merged = sorted((m for m in merged if len(m.points) >= 2), key=lambda m: (m.kind, m.points.tolist()))
    kind = np.array([m.kind for m in merged], np.int64)
    first = np.concatenate(([0], np.cumsum([len(m.source_rows) for m in merged]))).astype(np.int64)
    rows = np.concatenate([m.source_rows for m in merged]).astype(np.int64) if merged else np.zeros(0, np.int64)
    merged_elements = MapElements.of(
        [m.points for m in merged],
        kind,
        sigma=_mean_sigma(pool, merged),
        style=_group_mean(pool.elements.style[rows], first),
    )
    sources = [np.unique(pool.observation_of_element[m.source_rows]) for m in merged]
    odds = compute_log_odds(pool, merged_elements, sources)
    length, full = merged_elements.lengths(), np.array(rules.full_score_length_m)[kind]
    score = np.minimum(1.0, length / np.maximum(full, 1e-9)) / (1.0 + np.exp(-odds / 4.0))
    score = score * _group_mean(pool.elements.score[rows, None], first)[:, 0]
    elements = MapElements(
        kind,
        merged_elements.offsets,
        merged_elements.points,
        score.clip(0.0, 1.0),
        merged_elements.sigma,
        merged_elements.style,
    )
    times = np.array([o.time_ns for o in pool.observations], np.int64)
    vector_map = VectorMap.of(
        elements,
        frame,
        [[pool.observations[k].id for k in seen] for seen in sources],
        [len({pool.observations[k].agent for k in seen}) for seen in sources],
        ([int(times[seen].min()) for seen in sources], [int(times[seen].max()) for seen in sources]),
        odds,
    )
    shown = (odds >= rules.publish_log_odds) & (vector_map.supporters >= rules.min_observations)
    shown &= length >= np.array(rules.min_published_length_m)[kind]
    return vector_map.with_state(np.where(shown, PUBLISHED, CANDIDATE))


def compute_log_odds(pool: ElementPool, elements: MapElements, sources: Sequence[Ints]) -> Floats:
    """Return (N,) the mean log-odds over places of each element, of which the observations in sources hold it and others may
    miss it.
    """
    if not len(elements):
        return np.zeros(0)
    closed = close_rings(elements.points, elements.offsets, elements.closed)
    places, offsets = resample_spaced(*closed, _PLACE_M)
    visible_pairs = find_near_pairs_between(elements.bounds(), _view_bounds(pool.observations), 0.0)
    start = np.searchsorted(visible_pairs[:, 0], np.arange(len(elements) + 1)).astype(np.int64)
    is_source = np.zeros(len(visible_pairs), np.bool_)
    for k, seen in enumerate(sources):
        is_source[start[k] : start[k + 1]] = np.isin(visible_pairs[start[k] : start[k + 1], 1], seen)
    hits = LOG_ODDS_HIT * np.array([len(seen) for seen in sources])
    pose = freeze(np.reshape([o.pose for o in pool.observations], (-1, 3)), np.float64)
    seen_by = _NearObservations(freeze(visible_pairs[:, 1], np.int64), start, is_source)
    return _compute_log_odds(places, offsets, seen_by, hits, pose, _visibility_rings(pool.observations))


class _NearObservations(NamedTuple):
    """Observations near each element: rows ``observation[first[k]:first[k + 1]]``, and which of them hold the element."""

    observation: I64x1
    first: I64x1
    holds_element: Boolx1


@njit(cache=True)
def _compute_log_odds(
    places: F64x2, offsets: I64x1, seen_by: _NearObservations, hit_sum: F64x1, pose: F64x2, fields: FieldsOfView
) -> F64x1:  # pragma: no cover - compiled
    """Return (N,) mean log-odds over the places (P, 2) of each element, ``places[first[k]:first[k + 1]]``, within the clamp."""
    observer, observer_offsets, is_source = seen_by
    out = np.zeros(len(offsets) - 1)
    for k in range(len(out)):
        for p in range(offsets[k], offsets[k + 1]):
            odds = hit_sum[k]
            for w in range(observer_offsets[k], observer_offsets[k + 1]):
                if not is_source[w]:
                    o = observer[w]
                    dx, dy = places[p, 0] - pose[o, 0], places[p, 1] - pose[o, 1]
                    c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
                    odds += LOG_ODDS_MISS * compute_visibility(
                        c * dx + s * dy, c * dy - s * dx, o, fields.views, fields.occluders, _MARGIN_M
                    )
            out[k] += min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)
        out[k] /= max(offsets[k + 1] - offsets[k], 1)
    return out


def _visibility_rings(observations: Sequence[Observation]) -> FieldsOfView:
    """Views and occluders of the observations, in their order."""
    count = len(observations)
    view_offsets = np.concatenate(([0], np.cumsum([len(o.view) for o in observations]))).astype(np.int64)
    view = np.concatenate([o.view for o in observations]) if count else np.zeros((0, 2))
    rings = [o.occluders.ring(r) for o in observations for r in range(len(o.occluders))]
    ring_offsets = np.concatenate(([0], np.cumsum([len(r) for r in rings]))).astype(np.int64)
    occluder_offsets = np.concatenate(([0], np.cumsum([len(o.occluders) for o in observations]))).astype(np.int64)
    hidden = np.concatenate(rings) if rings else np.zeros((0, 2))
    return FieldsOfView(
        ObservationRings(view, view_offsets, np.arange(count + 1)),
        ObservationRings(hidden, ring_offsets, occluder_offsets),
    )


def _view_bounds(observations: Sequence[Observation]) -> Floats:
    """Return (O, 4) boxes of the views in the map's frame."""
    rings = MapElements.of([o.view for o in observations], CROSSING)
    pose = np.repeat(np.reshape([o.pose for o in observations], (-1, 3)), rings.counts, axis=0)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = rings.points.T
    return rings.with_points(np.stack((c * x - s * y, s * x + c * y), 1) + pose[:, :2]).bounds()


def _group_mean(values: Floats, offsets: Ints) -> Floats:
    """Return (N, C) means over the rows of each merged element; none is without rows."""
    if len(offsets) == 1:
        return np.zeros((0, values.shape[1]))
    return np.add.reduceat(values, offsets[:-1], axis=0) / np.diff(offsets)[:, None]


def _mean_sigma(pool: ElementPool, merged: Sequence[MergedElement]) -> Floats:
    """Return (P,) the mean sigma of what was merged, at each of its points."""
    sizes = [len(m.points) for m in merged]
    if not merged:
        return np.zeros(0)
    means = []
    for m in merged:
        _, places = take_rows(pool.elements.offsets, m.source_rows)
        means.append(pool.elements.sigma[places].mean())
    return np.repeat(means, sizes)
