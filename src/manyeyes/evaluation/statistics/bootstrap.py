# SPDX-License-Identifier: Apache-2.0
"""How sure a number is: percentile bootstrap over *scenarios*, and the verdict on a bar.

Frames of one scenario are strongly correlated, so whole scenarios are drawn with replacement, never frames. A scenario
drawn k times stands k times in the list of detections and in the count of truth; since its copies have equal scores,
this is a weight k on each of its rows, and one global sort serves all resamples. AP is recomputed on each resample (it is
no mean of per-scenario APs). Two methods are compared on the *same* resamples, which cancels how hard a scenario is.
Resamples without any truth are left out. Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13.

Where two *different* detections tie exactly in score, and for a protocol that concatenates frames instead of sorting, a
weight repeats each detection in its place, where writing the scenario out again would interleave the copies; that moves
the running precision by less than the ties themselves do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.average_precision import (
    PROTOCOLS,
    FrameMatch,
    Protocol,
    counted_truth,
    in_dataset_order,
)
from manyeyes.ops.keyed_random import keyed_uniform

Verdict = Literal["reached", "missed", "not resolved"]
_CHUNK_ROWS = 4_000_000


@dataclass(frozen=True)
class Interval:
    """A number with its percentile interval at a level, from so many scenarios."""

    value: float
    low: float
    high: float
    level: float
    scenarios: int


@dataclass(frozen=True)
class Pooled:
    """Detections of many scenarios as one list in the protocol's order.

    tp: (D,) bool; scenario: (D,) row of names; n_gt: (S,) truth boxes of each scenario.
    """

    names: tuple[str, ...]
    tp: np.ndarray
    scenario: np.ndarray
    n_gt: np.ndarray
    drop_first_segment: bool


Statistic = Callable[[Pooled, np.ndarray], np.ndarray]
"""(pool, weights (R, S)) -> (R,): the statistic on R resamples, given how often each scenario was drawn."""


def weighted_ap(pool: Pooled, weights: np.ndarray) -> np.ndarray:
    """AP (R,) of each resample (R, S); NaN where it holds no truth. Weights of one give the plain AP."""
    ap = np.full(len(weights), np.nan)
    n_gt = weights @ pool.n_gt
    step = max(1, _CHUNK_ROWS // max(1, len(pool.tp)))
    for begin in range(0, len(weights), step):
        rows = slice(begin, begin + step)
        weight = weights[rows][:, pool.scenario].astype(np.float64)
        gain = weight * pool.tp
        seen = np.cumsum(weight, 1)
        precision = np.cumsum(gain, 1) / np.maximum(seen, 1)
        envelope = np.maximum.accumulate(precision[:, ::-1], 1)[:, ::-1]
        if pool.drop_first_segment:
            gain -= pool.tp * ((seen == weight) & (weight > 0))
        with np.errstate(invalid="ignore", divide="ignore"):
            ap[rows] = np.where(n_gt[rows] > 0, (gain * envelope).sum(1) / n_gt[rows], np.nan)
    return ap


def weighted_recall(pool: Pooled, weights: np.ndarray) -> np.ndarray:
    """Recall (R,) of each resample (R, S) at the protocol's score threshold."""
    hits = np.bincount(pool.scenario, weights=pool.tp, minlength=len(pool.names))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (weights @ hits) / (weights @ pool.n_gt)


@dataclass(frozen=True)
class Drawn:
    """A statistic of matched frames on all scenarios and on every resample of them, draws (R,); n_gt (S,) is their truth."""

    names: tuple[str, ...]
    n_gt: np.ndarray
    value: float
    draws: np.ndarray
    level: float
    same_truth: bool

    def interval(self) -> Interval:
        """The value and its interval."""
        return _interval(self.value, self.draws, self.level, len(self.names))

    def less(self, other: Drawn) -> Interval:
        """This statistic minus the other on the same resamples, of the same scenarios with equal truth."""
        if self.names != other.names:
            odd = sorted(set(self.names) ^ set(other.names))
            raise ConfigError(
                f"A paired difference needs the same scenarios on both sides; {', '.join(odd[:5])} are on one only."
            )
        if self.same_truth and not np.array_equal(self.n_gt, other.n_gt):
            odd = self.names[int(np.argmax(self.n_gt != other.n_gt))]
            raise ConfigError(f"A paired difference needs the same truth on both sides; scenario {odd} differs.")
        return _interval(self.value - other.value, self.draws - other.draws, self.level, len(self.names))


def drawn(
    matches: Sequence[FrameMatch],
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
    protocol: Protocol = PROTOCOLS["manyeyes"],
    statistic: Statistic = weighted_ap,
) -> Drawn:
    """The AP (or another statistic) of matched frames on n resamples, made once for any number of differences."""
    pool = _pooled(matches, protocol)
    value = float(statistic(pool, np.ones((1, len(pool.names)), dtype=np.int64))[0])
    draws = statistic(pool, resamples(len(pool.names), n, seed))
    return Drawn(pool.names, pool.n_gt, value, draws, level, protocol.count_frames_without_det)


def scenario_interval(
    matches: Sequence[FrameMatch],
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
    protocol: Protocol = PROTOCOLS["manyeyes"],
    statistic: Statistic = weighted_ap,
) -> Interval:
    """The AP (or another statistic) of matched frames and its interval over scenarios."""
    return drawn(matches, n, seed, level, protocol, statistic).interval()


def paired_difference(
    a: Sequence[FrameMatch],
    b: Sequence[FrameMatch],
    n: int = 1000,
    seed: int = 0,
    level: float = 0.95,
    protocol: Protocol = PROTOCOLS["manyeyes"],
    statistic: Statistic = weighted_ap,
) -> Interval:
    """Statistic of a minus that of b, both on the same resampled scenarios, which must be the same with equal truth."""
    ours, theirs = (drawn(matches, n, seed, level, protocol, statistic) for matches in (a, b))
    return ours.less(theirs)


def mean_interval(values: Sequence[float], n: int = 1000, seed: int = 0, level: float = 0.95) -> Interval:
    """The mean of one number per scenario (bytes, milliseconds, a difference) and its interval; NaN values are refused."""
    numbers = np.asarray(values, dtype=np.float64)
    if np.isnan(numbers).any():
        raise ConfigError(f"mean_interval needs a number per scenario; {int(np.isnan(numbers).sum())} are NaN.")
    draws = resamples(len(numbers), n, seed) @ numbers / max(1, len(numbers))
    return _interval(float(numbers.mean()) if len(numbers) else math.nan, draws, level, len(numbers))


def resolved(bar: float, low: float, high: float) -> Verdict:
    """The verdict on a bar: reached when the whole interval is at or above it, missed when it is below, else undecided."""
    if low >= bar:
        return "reached"
    return "missed" if high < bar else "not resolved"


def resamples(scenarios: int, n: int, seed: int) -> np.ndarray:
    """(n, scenarios) int64: how often each scenario is drawn in each resample; a function of its arguments alone."""
    if scenarios == 0:
        return np.zeros((n, 0), dtype=np.int64)
    drawn = (keyed_uniform((n, scenarios), seed, "bootstrap").numpy() * scenarios).astype(np.int64)
    flat = drawn + scenarios * np.arange(n)[:, None]
    return np.bincount(flat.ravel(), minlength=n * scenarios).reshape(n, scenarios)


def _pooled(matches: Sequence[FrameMatch], protocol: Protocol) -> Pooled:
    matches = in_dataset_order(matches)
    names = tuple(dict.fromkeys(match.scenario for match in matches))
    row = {name: k for k, name in enumerate(names)}
    n_gt = np.zeros(len(names), dtype=np.int64)
    for match in matches:
        n_gt[row[match.scenario]] += counted_truth(match, protocol)
    if not matches:
        return Pooled(names, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64), n_gt, protocol.drop_first_segment)
    tp = np.concatenate([match.tp.numpy() for match in matches])
    scenario = np.repeat([row[match.scenario] for match in matches], [len(match.score) for match in matches])
    score = np.concatenate([match.score.numpy() for match in matches])
    order = np.argsort(-score, kind="stable") if protocol.sort == "global" else np.arange(len(score))
    return Pooled(names, tp[order], scenario[order], n_gt, protocol.drop_first_segment)


def _interval(value: float, draws: np.ndarray, level: float, scenarios: int) -> Interval:
    if not 0 < level < 1:
        raise ConfigError(f"The level of an interval lies between 0 and 1; got {level}.")
    draws = draws[~np.isnan(draws)]
    if not len(draws):
        return Interval(value, math.nan, math.nan, level, scenarios)
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return Interval(value, float(low), float(high), level, scenarios)
