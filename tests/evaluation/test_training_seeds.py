# SPDX-License-Identifier: Apache-2.0
"""Several trainings of a method, summarised by hand."""

import math

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.training_seeds import (
    SeedRun,
    compare_with_baselines,
    compute_pooled_std,
    summarize_seeds,
)


def run(method: str, seed: int, value: float, spread: float = 0.1, scenarios: tuple[str, ...] = ("a", "b")) -> SeedRun:
    """Resamples lie evenly from spread below the value to spread above it."""
    return SeedRun(method, seed, value, value + np.linspace(-spread, spread, 41), scenarios)


RUNS = [
    run("ours", 5, 0.80), run("ours", 6, 0.82), run("ours", 7, 0.84),
    run("near", 5, 0.79), run("near", 6, 0.80), run("near", 7, 0.81),
    run("far", 5, 0.70),
]  # fmt: skip


def test_mean_interval_and_spread_by_hand() -> None:
    ours, near, far = summarize_seeds(RUNS)
    assert (ours.method, ours.seeds) == ("ours", (5, 6, 7)) and ours.mean.num_scenarios == 2
    assert ours.mean.value == pytest.approx(0.82) and ours.seed_std == pytest.approx(0.02)
    assert near.seed_std == pytest.approx(0.01) and math.isnan(far.seed_std)
    assert (ours.mean.low, ours.mean.high) == (pytest.approx(0.725), pytest.approx(0.915))


def test_the_interval_is_of_the_mean_over_seeds_not_of_a_seed() -> None:
    """On resamples where one seed loses what another gains, the mean stays."""
    rising = SeedRun("m", 1, 0.5, np.linspace(0.4, 0.6, 41), ("a", "b"))
    falling = SeedRun("m", 2, 0.5, np.linspace(0.6, 0.4, 41), ("a", "b"))
    (summary,) = summarize_seeds([rising, falling])
    assert summary.mean.low == pytest.approx(0.5) and summary.mean.high == pytest.approx(0.5)


def test_the_spread_is_pooled_over_methods_with_several_seeds() -> None:
    """sqrt((2 * 0.02^2 + 2 * 0.01^2) / 4) = 0.0158."""
    assert compute_pooled_std(summarize_seeds(RUNS)) == pytest.approx(math.sqrt(0.00025))
    assert math.isnan(compute_pooled_std(summarize_seeds(RUNS[:1] + RUNS[-1:])))


def test_differences_below_twice_the_pooled_spread_are_not_claimed() -> None:
    """Twice 0.0158 is 0.0316: 0.02 over "near" is not claimed, 0.12 over "far" is."""
    near, far = compare_with_baselines(summarize_seeds(RUNS), "ours")
    assert near.interval.value == pytest.approx(0.02) and not near.is_claimed
    assert far.interval.value == pytest.approx(0.12) and far.is_claimed
    assert compare_with_baselines(summarize_seeds(RUNS), "none of them") == ()


def test_a_difference_of_exactly_twice_the_spread_is_claimed_and_one_below_zero_too() -> None:
    """Both methods have a spread of 0.01: means 0.50 and 0.52."""
    runs = [
        run(m, s, v)
        for m, values in (("a", (0.49, 0.50, 0.51)), ("b", (0.51, 0.52, 0.53)))
        for s, v in enumerate(values)
    ]
    (difference,) = compare_with_baselines(summarize_seeds(runs), "a")
    assert difference.interval.value == pytest.approx(-0.02) and difference.is_claimed


def test_without_a_second_seed_nothing_is_claimed() -> None:
    (difference,) = compare_with_baselines(summarize_seeds([run("a", 1, 0.9), run("b", 1, 0.1)]), "a")
    assert difference.interval.value == pytest.approx(0.8) and not difference.is_claimed


def test_runs_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ConfigError, match="ours has a seed twice: 5, 5"):
        summarize_seeds([run("ours", 5, 0.1), run("ours", 5, 0.2)])
    with pytest.raises(ConfigError, match="those of far, seed 2, differ from those of ours, seed 1"):
        summarize_seeds([run("ours", 1, 0.1), run("far", 2, 0.2, scenarios=("a", "c"))])
