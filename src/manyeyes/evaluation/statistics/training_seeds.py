# SPDX-License-Identifier: Apache-2.0
"""Methods that were trained several times, from different seeds: mean, interval over scenarios, and spread over trainings.

The metric of a method is the mean over its seeds. Its interval is over scenarios: the mean over seeds is taken on each
resample, and resamples are the same for all runs. The spread over trainings is the standard deviation over seeds (n - 1),
pooled over methods as the square root of sum (n - 1) s^2 / sum (n - 1). A difference of two methods is claimed only where it is
at least CLAIM_FACTOR times the pooled standard deviation; without any method of two seeds nothing is claimed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.bootstrap import Interval, make_interval

CLAIM_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class SeedRun:
    """A metric of one training of a method. seed: of the training. resamples: (R,) the metric on each resample of the scenarios."""

    method: str
    seed: int
    value: float
    resamples: NDArray[np.float64]
    scenarios: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SeedSummary:
    """A method over its seeds. mean: with the interval over scenarios. seed_std: NaN of one seed."""

    method: str
    seeds: tuple[int, ...]
    mean: Interval
    seed_std: float
    resamples: NDArray[np.float64]


@dataclass(frozen=True)
class SeedDifference:
    """A difference of means, paired over scenarios. is_claimed: it is large against the spread over trainings."""

    method: str
    baseline: str
    interval: Interval
    is_claimed: bool


def summarize_seeds(runs: Sequence[SeedRun]) -> tuple[SeedSummary, ...]:
    """Summarise runs by method, in their order.

    Raises:
        ConfigError: a method has a seed twice, or runs are of different scenarios.
    """
    for run in runs:
        if run.scenarios != runs[0].scenarios or len(run.resamples) != len(runs[0].resamples):
            raise ConfigError(
                f"Runs of several seeds need the same scenarios; those of {run.method}, seed {run.seed}, differ from those of "
                f"{runs[0].method}, seed {runs[0].seed}: evaluate all on one split."
            )
    return tuple(
        _summarize([run for run in runs if run.method == name]) for name in dict.fromkeys(r.method for r in runs)
    )


def _summarize(runs: Sequence[SeedRun]) -> SeedSummary:
    seeds = tuple(run.seed for run in runs)
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"{runs[0].method} has a seed twice: {', '.join(map(str, seeds))}; give each training once.")
    values = np.array([run.value for run in runs])
    resamples = np.mean([run.resamples for run in runs], axis=0)
    mean = make_interval(float(values.mean()), resamples, 0.95, len(runs[0].scenarios))
    return SeedSummary(runs[0].method, seeds, mean, float(values.std(ddof=1)) if len(runs) > 1 else math.nan, resamples)


def compute_pooled_std(summaries: Sequence[SeedSummary]) -> float:
    """Return the standard deviation over seeds, pooled over methods; NaN where no method has two seeds."""
    several = [s for s in summaries if len(s.seeds) > 1]
    freedom = sum(len(s.seeds) - 1 for s in several)
    return math.sqrt(sum((len(s.seeds) - 1) * s.seed_std**2 for s in several) / freedom) if freedom else math.nan


def compare_with_baselines(summaries: Sequence[SeedSummary], method: str) -> tuple[SeedDifference, ...]:
    """Compare one method with every other; nothing where it is not among them."""
    ours, pooled_std = next((s for s in summaries if s.method == method), None), compute_pooled_std(summaries)
    if ours is None:
        return ()
    out = []
    for other in (s for s in summaries if s.method != method):
        value = ours.mean.value - other.mean.value
        interval = make_interval(value, ours.resamples - other.resamples, 0.95, ours.mean.num_scenarios)
        # NaN is at most no number: without a spread nothing is claimed. Rounding must not decide at equality.
        is_claimed = bool(abs(value) >= CLAIM_FACTOR * pooled_std - 1e-12)
        out.append(SeedDifference(method, other.method, interval, is_claimed))
    return tuple(out)
