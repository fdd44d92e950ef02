# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals by percentile bootstrap over *scenarios*.

Frames of one scenario are strongly correlated, so whole scenarios are drawn with replacement, never frames. A scenario
drawn k times stands k times in the list of detections and in the count of truth; since its copies have equal scores,
this is a weight k on each of its rows, and one global sort serves all resamples. AP is recomputed on each resample (it is
no mean of per-scenario APs). Two methods are compared on the *same* resamples, which cancels how hard a scenario is.
Resamples without any truth are left out. Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13.

A protocol that evaluates equal scores together is exact with weights. Where a protocol orders ties, or concatenates frames
instead of sorting, a weight repeats each detection in its place, where writing the scenario out again would interleave the
copies; that moves the running precision by less than the ties themselves do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.frame_match import (
    FrameMatch,
    count_truth,
    rank_matches,
    sort_by_frame,
)
from manyeyes.evaluation.detection.protocols import PROTOCOLS, DetectionProtocol
from manyeyes.evaluation.statistics._resample_kernels import resample_ap
from manyeyes.ops.keyed_random import keyed_uniform


@dataclass(frozen=True)
class Interval:
    """A number with its percentile interval at a level, from so many scenarios."""

    value: float
    low: float
    high: float
    confidence_level: float
    num_scenarios: int

    def __neg__(self) -> Interval:
        return Interval(-self.value, -self.high, -self.low, self.confidence_level, self.num_scenarios)


@dataclass(frozen=True)
class PooledMatches:
    """Detections of many scenarios as one list in the protocol's order.

    tp: (D,) bool; scenario_row: (D,) row of names; n_gt: (S,) truth boxes of each scenario. group_start: (K,) where each group of
    detections begins that are one step; None: each is a step, in its place.
    """

    names: tuple[str, ...]
    tp: np.ndarray
    scenario_row: np.ndarray
    n_gt: np.ndarray
    drop_first_segment: bool
    group_start: np.ndarray | None = None


Statistic = Callable[[PooledMatches, np.ndarray], np.ndarray]
"""(pool, weights (R, S)) -> (R,): the statistic on R resamples, given how often each scenario was drawn."""


def weighted_ap(pool: PooledMatches, weights: np.ndarray) -> np.ndarray:
    """Return AP (R,) of each resample (R, S); NaN where it holds no truth. Weights of one give the plain AP."""
    start = pool.group_start
    last = np.arange(len(pool.tp)) if start is None else np.append(start[1:], len(pool.tp))[: len(start)] - 1
    # Of several copies of the first detection only the first is left out, unless copies are one step.
    max_dropped = 0 if not pool.drop_first_segment else 1 if start is None else np.iinfo(np.int64).max
    tp, row = np.ascontiguousarray(pool.tp, np.bool_), np.ascontiguousarray(pool.scenario_row, np.int64)
    n_gt, drawn = np.ascontiguousarray(pool.n_gt, np.int64), np.ascontiguousarray(weights, np.int64)
    return resample_ap(tp, row, last, n_gt, drawn, max_dropped)


def weighted_recall(pool: PooledMatches, weights: np.ndarray) -> np.ndarray:
    """Return recall (R,) of each resample (R, S) at the protocol's score threshold."""
    hits = np.bincount(pool.scenario_row, weights=pool.tp, minlength=len(pool.names))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (weights @ hits) / (weights @ pool.n_gt)


@dataclass(frozen=True)
class BootstrapSamples:
    """A statistic of matched frames on all scenarios and on every resample of them, draws (R,); n_gt (S,) is their truth."""

    names: tuple[str, ...]
    n_gt: np.ndarray
    value: float
    samples: np.ndarray
    confidence_level: float
    same_truth: bool

    def interval(self) -> Interval:
        """Return the value and its interval."""
        return make_interval(self.value, self.samples, self.confidence_level, len(self.names))

    def paired_difference(self, other: BootstrapSamples) -> Interval:
        """This statistic minus the other on the same resamples, of the same scenarios with equal truth."""
        if self.names != other.names:
            unpaired = sorted(set(self.names) ^ set(other.names))
            raise ConfigError(
                f"A paired difference needs the same scenarios on both sides; {', '.join(unpaired[:5])} are on one only."
            )
        if self.same_truth and not np.array_equal(self.n_gt, other.n_gt):
            unpaired = self.names[int(np.argmax(self.n_gt != other.n_gt))]
            raise ConfigError(f"A paired difference needs the same truth on both sides; scenario {unpaired} differs.")
        return make_interval(
            self.value - other.value, self.samples - other.samples, self.confidence_level, len(self.names)
        )


def bootstrap(
    matches: Sequence[FrameMatch],
    num_resamples: int = 1000,
    seed: int = 0,
    confidence_level: float = 0.95,
    protocol: DetectionProtocol = PROTOCOLS["global-sort"],
    statistic: Statistic = weighted_ap,
) -> BootstrapSamples:
    """Return the AP (or another statistic) of matched frames on n resamples, made once for any number of differences."""
    pool = _pool_matches(matches, protocol)
    value = float(statistic(pool, np.ones((1, len(pool.names)), dtype=np.int64))[0])
    weights = draw_resamples(len(pool.names), num_resamples, seed)
    # All resamples of one scenario are equal.
    samples = (
        statistic(pool, weights) if len(pool.names) > 1 else np.repeat(statistic(pool, weights[:1]), num_resamples)
    )
    return BootstrapSamples(pool.names, pool.n_gt, value, samples, confidence_level, protocol.count_frames_without_det)


def mean_interval(
    values: Sequence[float], num_resamples: int = 1000, seed: int = 0, confidence_level: float = 0.95
) -> Interval:
    """Return the mean of one number per scenario (bytes, milliseconds, a difference) and its interval; NaN values are refused."""
    numbers = np.asarray(values, dtype=np.float64)
    if np.isnan(numbers).any():
        raise ConfigError(f"mean_interval needs a number per scenario; {int(np.isnan(numbers).sum())} are NaN.")
    samples = draw_resamples(len(numbers), num_resamples, seed) @ numbers / max(1, len(numbers))
    return make_interval(float(numbers.mean()) if len(numbers) else math.nan, samples, confidence_level, len(numbers))


def draw_resamples(num_scenarios: int, num_resamples: int, seed: int) -> np.ndarray:
    """Return (n, scenarios) int64: how often each scenario is drawn in each resample; a function of its arguments alone."""
    if num_scenarios == 0:
        return np.zeros((num_resamples, 0), dtype=np.int64)
    chosen = (keyed_uniform((num_resamples, num_scenarios), seed, "bootstrap").numpy() * num_scenarios).astype(np.int64)
    flat = chosen + num_scenarios * np.arange(num_resamples)[:, None]
    return np.bincount(flat.ravel(), minlength=num_resamples * num_scenarios).reshape(num_resamples, num_scenarios)


def _pool_matches(matches: Sequence[FrameMatch], protocol: DetectionProtocol) -> PooledMatches:
    matches = sort_by_frame(matches)
    names = tuple(dict.fromkeys(match.scenario for match in matches))
    row = {name: k for k, name in enumerate(names)}
    n_gt = np.zeros(len(names), dtype=np.int64)
    for match in matches:
        n_gt[row[match.scenario]] += count_truth(match, protocol)
    ranked = rank_matches(matches, protocol, protocol.ap_order)
    frame_scenario = np.array([row[match.scenario] for match in matches], dtype=np.int64)
    group_start = ranked.group_start if protocol.ties == "together" else None
    scenario_row = frame_scenario[ranked.frame]
    return PooledMatches(names, ranked.tp, scenario_row, n_gt, protocol.drop_first_segment, group_start)


def exact_interval(value: float) -> Interval:
    """Return a number without an interval, as of a single scenario."""
    return Interval(value, value, value, 0.95, 1)


def make_interval(value: float, samples: np.ndarray, confidence_level: float, num_scenarios: int) -> Interval:
    """Return the percentile interval of samples (R,) about a value; NaN samples are left out, NaN bounds without any sample."""
    if not 0 < confidence_level < 1:
        raise ConfigError(f"The level of an interval lies between 0 and 1; got {confidence_level}.")
    samples = samples[~np.isnan(samples)]
    if not len(samples):
        return Interval(value, math.nan, math.nan, confidence_level, num_scenarios)
    low, high = np.quantile(samples, [(1 - confidence_level) / 2, (1 + confidence_level) / 2])
    return Interval(value, float(low), float(high), confidence_level, num_scenarios)
