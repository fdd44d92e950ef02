# SPDX-License-Identifier: Apache-2.0
"""What every rival shares with manyeyes' own fusion, so that only the merging is compared.

Pre-filter: elements below a score, and lines below a length, are left out; the same observation given twice counts once, and the
order of input plays no part (sorted by time, then id). Poses are taken as claimed.

Score: sigmoid(L / 4) min(1, length / full), as in specs/maps.md 3.4 stage 7, times the mean score of the merged elements. L is the
mean over places of an element of its log-odds: log(P_D / P_FA) for each merged observation, and v log((1 - P_D) / (1 - P_FA)) for
each other observation that could see the place with visibility v; |L| is at most 6.

State: published where L, the count of observations and the length reach the rule's least; else candidate.
Cuts: none here; who compares maps cuts all of them by one policy (lines at junctions).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x1, njit
from manyeyes.datatypes.map_element import CROSSING, MapElements, frozen, rows_of
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import CANDIDATE, PUBLISHED, VectorMap
from manyeyes.maps.fusion.observation_arrays import FieldsOfView, Rings, sight
from manyeyes.ops.polyline import close_rings, near_pairs_between, resample_spaced

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DETECTION, FALSE_ALARM, CLAMP = 0.7, 0.15, 6.0
HIT = math.log(DETECTION / FALSE_ALARM)
MISS = math.log((1 - DETECTION) / (1 - FALSE_ALARM))
_PLACE_M, _MARGIN_M = 2.0, 2.0


@dataclass(frozen=True)
class Rules:
    """The shared rules' numbers. By kind (divider, boundary, crossing, stop line): min_seen_m, the shortest element that is
    used, least_m, the shortest that is published, and full_score_m, the length from which a score is not lowered.

    min_score: of an element that is used. publish: least log-odds and least_observations: of what is published.
    """

    min_score: float = 0.3
    min_seen_m: tuple[float, float, float, float] = (4.0, 4.0, 0.0, 1.0)
    least_m: tuple[float, float, float, float] = (8.0, 8.0, 0.0, 2.0)
    full_score_m: tuple[float, float, float, float] = (20.0, 20.0, 0.0, 3.0)
    publish: float = -CLAMP
    least_observations: int = 1


@dataclass(frozen=True, eq=False)
class Pool:
    """What passed the pre-filter: observations (O), each once, by time; elements (N) in the map's frame; observation (N,)."""

    observations: tuple[Observation, ...]
    elements: MapElements
    observation: Ints

    def lines(self) -> tuple[Floats, Ints]:
        """Points and offsets of the elements with rings closed."""
        return close_rings(self.elements.points, self.elements.first, self.elements.closed)

    def order(self, rows: Ints) -> Ints:
        """The rows from the most plausible on: by score, then length, then least corner."""
        low = self.elements.bounds()[rows]
        length = np.round(self.elements.lengths()[rows], 6)
        return rows[np.lexsort((low[:, 1], low[:, 0], -length, -self.elements.score[rows]))]


@dataclass(frozen=True, eq=False)
class Merged:
    """One element of a map on its way: its points (K, 2), rings open; its kind; and the rows of the pool that it was made of."""

    points: Floats
    kind: int
    rows: Ints


def pool(observations: Sequence[Observation], rules: Rules) -> Pool:
    """The observations after the pre-filter, in one order."""
    once = {o.id: o for o in observations}
    chosen = tuple(sorted(once.values(), key=lambda o: (o.time_ns, o.id)))
    elements = MapElements.cat([o.in_map() for o in chosen])
    owner = np.repeat(np.arange(len(chosen)), [len(o.elements) for o in chosen]).astype(np.int64)
    stays = (elements.score >= rules.min_score) & (elements.lengths() >= np.array(rules.min_seen_m)[elements.kind])
    return Pool(chosen, elements.take(stays), owner[stays])


def as_map(of: Pool, merged: Sequence[Merged], rules: Rules, frame: Frame | None) -> VectorMap:
    """The merged elements as a map in canonical order, with the shared score and state."""
    merged = sorted((m for m in merged if len(m.points) >= 2), key=lambda m: (m.kind, m.points.tolist()))
    kind = np.array([m.kind for m in merged], np.int64)
    first = np.concatenate(([0], np.cumsum([len(m.rows) for m in merged]))).astype(np.int64)
    rows = np.concatenate([m.rows for m in merged]).astype(np.int64) if merged else np.zeros(0, np.int64)
    plain = MapElements.of(
        [m.points for m in merged], kind, sigma=_sigma(of, merged), style=_mean(of.elements.style[rows], first)
    )
    sources = [np.unique(of.observation[m.rows]) for m in merged]
    odds = log_odds(of, plain, sources)
    length, full = plain.lengths(), np.array(rules.full_score_m)[kind]
    score = np.minimum(1.0, length / np.maximum(full, 1e-9)) / (1.0 + np.exp(-odds / 4.0))
    score = score * _mean(of.elements.score[rows, None], first)[:, 0]
    elements = MapElements(kind, plain.first, plain.points, score.clip(0.0, 1.0), plain.sigma, plain.style)
    times = np.array([o.time_ns for o in of.observations], np.int64)
    made = VectorMap.of(
        elements,
        frame,
        [[of.observations[k].id for k in seen] for seen in sources],
        [len({of.observations[k].agent for k in seen}) for seen in sources],
        ([int(times[seen].min()) for seen in sources], [int(times[seen].max()) for seen in sources]),
        odds,
    )
    shown = (odds >= rules.publish) & (made.supporters >= rules.least_observations)
    shown &= length >= np.array(rules.least_m)[kind]
    return made.with_state(np.where(shown, PUBLISHED, CANDIDATE))


def log_odds(of: Pool, elements: MapElements, sources: Sequence[Ints]) -> Floats:
    """(N,) the mean log-odds over places of each element, of which the observations in sources hold it and others may miss it."""
    if not len(elements):
        return np.zeros(0)
    closed = close_rings(elements.points, elements.first, elements.closed)
    places, first = resample_spaced(*closed, _PLACE_M)
    who = near_pairs_between(elements.bounds(), _view_bounds(of.observations), 0.0)
    start = np.searchsorted(who[:, 0], np.arange(len(elements) + 1)).astype(np.int64)
    holds = np.zeros(len(who), np.bool_)
    for k, seen in enumerate(sources):
        holds[start[k] : start[k + 1]] = np.isin(who[start[k] : start[k + 1], 1], seen)
    hits = HIT * np.array([len(seen) for seen in sources])
    pose = frozen(np.reshape([o.pose for o in of.observations], (-1, 3)), np.float64)
    seen_by = _NearObservations(frozen(who[:, 1], np.int64), start, holds)
    return _log_odds(places, first, seen_by, hits, pose, _rings(of.observations))


class _NearObservations(NamedTuple):
    """Observations near each element: rows ``observation[first[k]:first[k + 1]]``, and which of them hold the element."""

    observation: I64x1
    first: I64x1
    holds_element: Boolx1


@njit(cache=True)
def _log_odds(
    places: F64x2, first: I64x1, seen_by: _NearObservations, hits: F64x1, pose: F64x2, fields: FieldsOfView
) -> F64x1:  # pragma: no cover - compiled
    """(N,) mean log-odds over the places (P, 2) of each element, ``places[first[k]:first[k + 1]]``, within the clamp."""
    who, start, holds = seen_by
    out = np.zeros(len(first) - 1)
    for k in range(len(out)):
        for p in range(first[k], first[k + 1]):
            odds = hits[k]
            for w in range(start[k], start[k + 1]):
                if not holds[w]:
                    o = who[w]
                    dx, dy = places[p, 0] - pose[o, 0], places[p, 1] - pose[o, 1]
                    c, s = np.cos(pose[o, 2]), np.sin(pose[o, 2])
                    odds += MISS * sight(c * dx + s * dy, c * dy - s * dx, o, fields.views, fields.occluders, _MARGIN_M)
            out[k] += min(max(odds, -CLAMP), CLAMP)
        out[k] /= max(first[k + 1] - first[k], 1)
    return out


def _rings(observations: Sequence[Observation]) -> FieldsOfView:
    """Views and occluders of the observations, in their order."""
    count = len(observations)
    first = np.concatenate(([0], np.cumsum([len(o.view) for o in observations]))).astype(np.int64)
    view = np.concatenate([o.view for o in observations]) if count else np.zeros((0, 2))
    rings = [o.occluders.ring(r) for o in observations for r in range(len(o.occluders))]
    ring_first = np.concatenate(([0], np.cumsum([len(r) for r in rings]))).astype(np.int64)
    of = np.concatenate(([0], np.cumsum([len(o.occluders) for o in observations]))).astype(np.int64)
    hidden = np.concatenate(rings) if rings else np.zeros((0, 2))
    return FieldsOfView(Rings(view, first, np.arange(count + 1)), Rings(hidden, ring_first, of))


def _view_bounds(observations: Sequence[Observation]) -> Floats:
    """(O, 4) boxes of the views in the map's frame."""
    rings = MapElements.of([o.view for o in observations], CROSSING)
    pose = np.repeat(np.reshape([o.pose for o in observations], (-1, 3)), rings.counts, axis=0)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = rings.points.T
    return rings.with_points(np.stack((c * x - s * y, s * x + c * y), 1) + pose[:, :2]).bounds()


def _mean(values: Floats, first: Ints) -> Floats:
    """(N, C) means over the rows of each merged element; none is without rows."""
    if len(first) == 1:
        return np.zeros((0, values.shape[1]))
    return np.add.reduceat(values, first[:-1], axis=0) / np.diff(first)[:, None]


def _sigma(of: Pool, merged: Sequence[Merged]) -> Floats:
    """(P,) the mean sigma of what was merged, at each of its points."""
    sizes = [len(m.points) for m in merged]
    if not merged:
        return np.zeros(0)
    means = []
    for m in merged:
        _, places = rows_of(of.elements.first, m.rows)
        means.append(of.elements.sigma[places].mean())
    return np.repeat(means, sizes)
