# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.average_precision import PROTOCOLS, FrameMatch, compute_ap
from manyeyes.evaluation.statistics.bootstrap import (
    PooledMatches,
    bootstrap,
    draw_resamples,
    mean_interval,
    weighted_ap,
    weighted_recall,
)

GLOBAL_SORT = PROTOCOLS["global-sort"]


def frames(scenarios=6, per=3, seed=0, skill=0.7, n_gt=8):
    """Random matched frames: a hit has a higher score on average; harder scenarios have fewer hits."""
    g = np.random.default_rng(seed)
    out = []
    for s in range(scenarios):
        for f in range(per):
            tp = g.random(10) < skill - 0.05 * s
            tp &= np.cumsum(tp) <= n_gt
            score = np.clip(g.normal(0.4 + 0.3 * tp, 0.15), 0.06, 0.99) + 1e-9 * g.random(10)
            order = np.argsort(-score, kind="stable")
            row = np.where(tp[order], np.arange(10), -1)
            out.append(FrameMatch(f"s{s}", f, torch.from_numpy(score[order]), torch.from_numpy(row), n_gt))
    return out


def slow_draws(matches, weights, protocol):
    """The slow twin: writes every resample out in full and computes its AP."""
    names = sorted({m.scenario for m in matches})
    for row in weights:
        copies = [
            replace(m, scenario=f"{m.scenario}/{k}")
            for name, times in zip(names, row, strict=True)
            for k in range(times)
            for m in matches
            if m.scenario == name
        ]
        yield compute_ap(copies, protocol).ap


@pytest.mark.parametrize("protocol", [GLOBAL_SORT, replace(GLOBAL_SORT, drop_first_segment=True)])
def test_interval_equals_the_slow_twin(protocol):
    matches = frames()
    got = bootstrap(matches, num_resamples=200, seed=3, confidence_level=0.9, protocol=protocol).interval()
    draws = np.array(list(slow_draws(matches, draw_resamples(6, 200, 3), protocol)))
    low, high = np.quantile(draws, [0.05, 0.95])
    assert got.value == pytest.approx(compute_ap(matches, protocol).ap, abs=1e-12)
    assert (got.low, got.high) == (pytest.approx(low, abs=1e-9), pytest.approx(high, abs=1e-9))
    assert got.low < got.value < got.high and got.num_scenarios == 6


def test_the_order_of_frames_changes_nothing():
    matches = frames()
    assert bootstrap(matches[::-1], num_resamples=50).interval() == bootstrap(matches, num_resamples=50).interval()
    assert (
        bootstrap(matches, num_resamples=50, seed=1).interval()
        != bootstrap(matches, num_resamples=50, seed=2).interval()
    )


def test_more_scenarios_give_a_narrower_interval():
    few, many = frames(scenarios=5), [replace(m, scenario=f"{m.scenario}/{k}") for k in range(10) for m in frames(5)]
    a, b = bootstrap(few).interval(), bootstrap(many).interval()
    assert b.value == pytest.approx(a.value, abs=1e-12)
    assert (b.high - b.low) < 0.5 * (a.high - a.low)


def test_pairing_cancels_what_makes_a_scenario_hard():
    a = frames(scenarios=6, per=10, seed=1)
    worse = [replace(m, truth_row=torch.where(m.truth_row == m.truth_row.max(), -1, m.truth_row)) for m in a]
    got = bootstrap(a).paired_difference(bootstrap(worse))
    alone_a, alone_b = bootstrap(a).interval(), bootstrap(worse).interval()
    assert got.value == pytest.approx(alone_a.value - alone_b.value)
    assert 0 < got.low < got.value < got.high
    assert got.high - got.low < 0.6 * (alone_a.high - alone_a.low)
    same = bootstrap(a).paired_difference(bootstrap(a))
    assert (same.value, same.low, same.high) == (0, 0, 0)


def test_a_pair_must_be_a_pair():
    a = frames(scenarios=3)
    with pytest.raises(ConfigError, match="s2 are on one only"):
        bootstrap(a).paired_difference(bootstrap([m for m in a if m.scenario != "s2"]))
    with pytest.raises(ConfigError, match="scenario s0 differs"):
        bootstrap(a).paired_difference(bootstrap([replace(a[0], n_gt=99), *a[1:]]))


def test_coverage_of_the_interval():
    """A 90 % interval over scenarios holds the truth about nine times of ten; one over frames would not."""
    generator = np.random.default_rng(0)
    inside = 0
    for trial in range(200):
        values = generator.normal(size=30)
        got = mean_interval(values.tolist(), num_resamples=300, seed=trial, confidence_level=0.9)
        inside += got.low <= 0 <= got.high
    assert 0.82 < inside / 200 < 0.95


def test_recall_and_empty_input():
    matches = frames(scenarios=4)
    got = bootstrap(matches, num_resamples=20, statistic=weighted_recall).interval()
    assert got.value == pytest.approx(compute_ap(matches, GLOBAL_SORT).recall)
    empty = bootstrap([], num_resamples=10).interval()
    assert math.isnan(empty.value) and math.isnan(empty.low) and empty.num_scenarios == 0
    no_truth = [replace(m, n_gt=0, truth_row=torch.full((10,), -1)) for m in matches]
    assert math.isnan(bootstrap(no_truth, num_resamples=10).interval().value)


def test_scenarios_without_detections_or_without_truth():
    matches = frames(scenarios=4)
    silent = FrameMatch("silent", 0, torch.zeros(0).double(), torch.zeros(0).long(), 8)
    got = bootstrap([*matches, silent], num_resamples=100).interval()
    assert got.value == pytest.approx(compute_ap([*matches, silent], GLOBAL_SORT).ap)
    assert got.value < bootstrap(matches, num_resamples=10).interval().value


def test_resamples_are_multinomial_and_pure():
    counts = draw_resamples(7, 2000, 5)
    assert counts.shape == (2000, 7) and (counts.sum(1) == 7).all()
    assert np.abs(counts.mean(0) - 1).max() < 0.1 and counts.max() >= 4
    assert np.array_equal(counts, draw_resamples(7, 2000, 5))


def plain_ap(pool: PooledMatches, weights: np.ndarray) -> float:
    """AP of one resample, (S,) weights, as its curve defines it: whole arrays, one weight a detection."""
    drawn = weights[pool.scenario_row].astype(float)
    start = np.arange(len(drawn)) if pool.group_start is None else pool.group_start
    weight, gain = (np.add.reduceat(values, start) for values in (drawn, drawn * pool.tp))
    seen = np.cumsum(weight)
    envelope = np.maximum.accumulate((np.cumsum(gain) / np.maximum(seen, 1))[::-1])[::-1]
    if pool.drop_first_segment:
        first = (seen == weight) & (weight > 0)
        gain = gain - np.where(first, np.minimum(gain, 1) if pool.group_start is None else gain, 0)
    return float((gain * envelope).sum() / (weights @ pool.n_gt))


@pytest.mark.parametrize("drop_first", [False, True])
@pytest.mark.parametrize("ties", ["none", "few", "all"])
def test_compiled_resamples_are_the_curves_of_whole_arrays(ties, drop_first):
    rng = np.random.default_rng(3)
    tp, row = rng.random(300) < 0.6, rng.integers(7, size=300)
    tp[:4] = True
    start = {"none": None, "few": np.flatnonzero(np.arange(300) % 3 != 1), "all": np.zeros(1, np.int64)}[ties]
    pool = PooledMatches(tuple("abcdefg"), tp, row, rng.integers(20, 60, size=7), drop_first, start)
    weights = draw_resamples(7, 40, 0)
    expected = [plain_ap(pool, each) for each in weights]
    assert len(set(expected)) > 1 or (ties == "all" and drop_first)
    np.testing.assert_allclose(weighted_ap(pool, weights), expected, rtol=1e-12)
