# SPDX-License-Identifier: Apache-2.0
"""Fitted maps of scores: isotonic by hand, calibrated on held-out boxes, few boxes stay near the raw score; AP is unchanged."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents.replay import ReplayConfig
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import benchmark
from manyeyes.evaluation.statistics.reliability import compute_reliability
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.score_calibration import SCORE_FORMS
from manyeyes.training.detector.score_calibration import ScoredBoxes, calibrate_detector, fit_isotonic, fit_score_map


def draw(count: int, seed: int) -> ScoredBoxes:
    """Boxes of which score squared is correct, in twice as many vehicles as are found."""
    rng = np.random.default_rng(seed)
    score = rng.uniform(0.05, 1.0, count)
    is_correct = rng.random(count) < score**2
    return ScoredBoxes(score, is_correct, 2 * int(is_correct.sum()))


def test_pooled_violators_by_hand():
    values, weights = np.array([1.0, 3.0, 2.0, 4.0, 0.0]), np.array([1.0, 1.0, 1.0, 1.0, 2.0])
    assert fit_isotonic(values, weights).tolist() == pytest.approx([1.0, 9 / 5, 9 / 5, 9 / 5, 9 / 5])
    assert fit_isotonic(np.array([1.0, 2.0]), np.ones(2)).tolist() == [1.0, 2.0]


def test_a_fitted_map_is_calibrated_on_other_boxes():
    fitted, other = fit_score_map(draw(4000, 0)), draw(4000, 1)
    mapped = fitted.apply(torch.from_numpy(other.score)).numpy()
    before, after = (compute_reliability(s, other.is_correct).expected_error for s in (other.score, mapped))
    assert before > 0.12 and after < 0.03
    assert np.array_equal(np.argsort(mapped, kind="stable"), np.argsort(other.score, kind="stable"))


def test_the_drawing_score_has_the_largest_f1():
    boxes = draw(4000, 0)
    fitted = fit_score_map(boxes)
    mapped = fitted.apply(torch.from_numpy(boxes.score)).numpy()

    def f1(threshold: float) -> float:
        drawn = mapped >= threshold
        return 2 * boxes.is_correct[drawn].sum() / (drawn.sum() + boxes.num_truth)

    assert f1(fitted.min_drawn) == pytest.approx(max(f1(t) for t in np.linspace(0.05, 1, 200)), abs=2e-3)


def test_few_or_no_boxes_stay_near_their_scores():
    none = fit_score_map(ScoredBoxes(np.zeros(0), np.zeros(0, dtype=bool), 3))
    assert none.raw == none.calibrated == (0.0, 0.05, 1.0)
    two = fit_score_map(ScoredBoxes(np.array([0.9, 0.8]), np.array([False, False]), 3))
    assert 0.5 < float(two.apply(torch.tensor([0.85]))) < 0.85


@pytest.mark.parametrize("seed", range(20))
def test_any_boxes_give_a_valid_map(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 900))
    score = rng.choice([0.01, 0.05, 0.3, 0.999999, 1.0], count) if seed % 2 else rng.beta(0.2, 0.2, count)
    fitted = fit_score_map(ScoredBoxes(score, rng.random(count) < rng.random(), int(rng.integers(0, 50))))
    assert 0 <= fitted.min_drawn <= 1


def test_reliability_by_hand():
    found = compute_reliability(np.array([0.05, 0.15, 0.15, 1.0]), np.array([False, True, False, True]))
    assert [(b.low, b.count, b.correct.value) for b in found.bins] == [(0.0, 1, 0.0), (0.1, 2, 0.5), (0.9, 1, 1.0)]
    assert found.expected_error == pytest.approx((0.05 + 2 * 0.35 + 0.0) / 4)
    assert all(b.correct.low <= b.correct.value <= b.correct.high for b in found.bins)
    assert math.isnan(compute_reliability(np.zeros(0), np.zeros(0, dtype=bool)).expected_error)


@pytest.mark.slow
def test_ap_is_unchanged_and_calibrated_weights_are_refused(toy):
    with torch.random.fork_rng():
        torch.manual_seed(3)
        detector = Detector(replace(COSTR_TINY, prune_threshold=0.0)).eval().requires_grad_(False)
    detector.head.out.bias[0] = 1.0
    recording = toy(agents_n=2, points_per_car=20, ground_points=60)
    methods = ("no-fusion", "late", "intermediate")
    replay = ReplayConfig()
    before = benchmark(recording, detector, methods, replay=replay)
    calibration, boxes = calibrate_detector(lambda: recording, detector)
    assert set(boxes) == set(SCORE_FORMS) and all(calibration.get(form) is not None for form in SCORE_FORMS)
    detector.score_calibration = calibration
    after = benchmark(recording, detector, methods, replay=replay)
    for method in methods:
        assert [r.n_detections for r in before[method].ap] == [r.n_detections for r in after[method].ap]
        assert [r.ap for r in before[method].ap] == pytest.approx([r.ap for r in after[method].ap], abs=1e-9)
    scores = [torch.cat([f.score for f in result["late"].ap[0].frames]) for result in (before, after)]
    assert not torch.equal(*scores)
    with pytest.raises(ConfigError, match="calibrated already"):
        calibrate_detector(lambda: recording, detector)
