# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.pose.metrics import (
    NOISE_KINDS,
    PoseEvaluation,
    PriorNoise,
    compute_displacement,
    compute_risk_coverage,
    count_confusion,
    evaluate_pose,
    make_oracle_estimate,
    summarize_by_common_objects,
    summarize_evaluations,
)
from manyeyes.pose.types import PoseStatus, lift_to_se3, no_estimate

TRUTH = np.array([10.0, -4.0, 1.0])
PLACES = np.array([[10.0, 6.0], [20.0, -4.0]])


def frame(status=PoseStatus.CORRECTED, common=5, metres=0.5, degrees=0.5, confidence=1.0, nees=3.0):
    if not status.has_estimate:
        return PoseEvaluation(status, common, math.inf, math.inf, math.nan, math.nan, -math.inf)
    return PoseEvaluation(status, common, metres, degrees, metres, nees, confidence)


def test_an_evaluation_by_hand():
    pose = TRUTH + [3.0, 4.0, math.radians(2.0)]
    estimate = replace(
        no_estimate(None, PoseStatus.CORRECTED),
        ego_from_other=lift_to_se3(pose, None),
        covariance=np.diag([9.0, 4.0, 1.0]),
        inliers=4,
    )
    found = evaluate_pose(estimate, TRUTH, PLACES)
    assert found.translation_error_m == pytest.approx(5.0) and found.rotation_error_deg == pytest.approx(2.0)
    assert found.nees == pytest.approx(1.0 + 4.0 + math.radians(2.0) ** 2)
    assert not found.is_within(5.0) and found.is_within(5.01)


def test_an_estimate_without_covariance_has_no_nees():
    estimate = replace(no_estimate(PriorNoise().make_prior(TRUTH, 0)), status=PoseStatus.OK, inliers=4)
    assert math.isnan(evaluate_pose(estimate, TRUTH, PLACES).nees)


def test_displacement_by_hand():
    assert compute_displacement(TRUTH + [3.0, 4.0, 0.0], TRUTH, PLACES) == pytest.approx(5.0)
    # Both places are 10 m from the other agent: turned by 0.1 rad about it, each moves by the chord.
    assert compute_displacement(TRUTH + [0.0, 0.0, 0.1], TRUTH, PLACES) == pytest.approx(20 * math.sin(0.05))
    assert math.isnan(compute_displacement(TRUTH, TRUTH, np.zeros((0, 2))))


def test_no_answer_is_a_failure_of_success_and_no_error():
    frames = [
        frame(),
        frame(metres=1.5),
        frame(metres=30.0),
        frame(PoseStatus.NO_MATCH),
        frame(PoseStatus.AMBIGUOUS, common=0),
    ]
    found = summarize_evaluations(frames)
    assert found.success_rate == (0.2, 0.4, 0.4)
    assert found.coverage == 0.6 and found.precision == pytest.approx(2 / 3) and found.false_accept_rate == 0.2
    assert found.no_overlap_accept_rate == 0.0 and found.median_translation_error_m == 1.5
    assert found.mean_translation_error_m == pytest.approx(32 / 3)
    assert summarize_evaluations([frame(common=0, metres=9.0)]).no_overlap_accept_rate == 1.0
    assert math.isnan(summarize_evaluations([]).coverage)


def test_a_prior_that_is_kept_is_not_an_estimate():
    prior = PriorNoise("gaussian", 0.1, 0.1).make_prior(TRUTH, 0)
    kept = evaluate_pose(no_estimate(prior), TRUTH, PLACES)
    assert (
        kept.translation_error_m < 1
        and summarize_evaluations([kept]).success_rate[0] == 0.0
        and kept.displacement_m < 1
    )


def test_buckets_split_by_common_objects():
    found = summarize_by_common_objects([frame(common=k) for k in (0, 1, 3, 4, 9, 12)])
    assert [(b, s.num_frames) for b, s in found] == [((0, 0), 1), ((1, 1), 1), ((3, 4), 2), ((8, 10**9), 2)]


def test_honest_covariances_have_nees_three():
    draws = np.random.default_rng(0).standard_normal((4000, 3))
    found = summarize_evaluations([frame(nees=float(d @ d)) for d in draws])
    assert found.nees == pytest.approx(3.0, abs=0.1) and found.within_95_fraction == pytest.approx(0.95, abs=0.01)
    # A chi^2 with three degrees of freedom has variance 6.
    assert found.nees_standard_error == pytest.approx(math.sqrt(6 / len(draws)), rel=0.1)
    assert math.isnan(summarize_evaluations([frame()]).nees_standard_error)


def test_risk_falls_with_confidence_and_ties_cannot_be_ordered():
    frames = [frame(metres=9.0, confidence=1.0), frame(confidence=2.0), frame(confidence=3.0)]
    coverage, risk = compute_risk_coverage(frames)
    np.testing.assert_allclose(coverage, [1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(risk, [0, 0, 1 / 3])
    tied = [frame(metres=9.0), frame()]
    for order in (tied, tied[::-1]):
        np.testing.assert_allclose(compute_risk_coverage(order)[1], [0.5, 0.5])


def test_confusion_counts_rows_as_injected():
    table = count_confusion([(PoseStatus.CONFLICT, PoseStatus.OK), (PoseStatus.CONFLICT, PoseStatus.CONFLICT)])
    assert table[2, 0] == table[2, 2] == 1 and table.sum() == 2


def test_the_oracle_is_right():
    assert evaluate_pose(make_oracle_estimate(TRUTH, None), TRUTH, PLACES).is_within(1e-6)


def test_noise_is_paired_over_sizes_and_a_pure_function_of_its_key():
    one, two = (PriorNoise("gaussian", s, s, seed=1).make_prior(TRUTH, 4, 2).pose - TRUTH for s in (0.5, 1.0))
    np.testing.assert_allclose(two, 2 * one, atol=1e-12)
    again = PriorNoise("gaussian", 0.5, 0.5, seed=1).make_prior(TRUTH, 4, 2).pose - TRUTH
    assert (again == one).all()
    bias = [PriorNoise("bias", 1.0, 1.0).make_prior(TRUTH, 3, k).pose for k in (0, 7)]
    assert (bias[0] == bias[1]).all()


@pytest.mark.parametrize("kind, sigma", [("gaussian", 1.0), ("laplace", math.sqrt(2)), ("gaussian_all", math.sqrt(2))])
def test_noise_has_the_size_that_its_prior_states(kind, sigma):
    truth = np.array([0.0, 0.0, 0.3])
    priors = [PriorNoise(kind, 1.0, 2.0).make_prior(truth, n) for n in range(400)]
    assert np.std([c.pose[0] for c in priors]) == pytest.approx(sigma, rel=0.15)
    assert math.sqrt(priors[0].covariance[0, 0]) == pytest.approx(sigma, rel=1e-6)


def test_a_yaw_error_of_the_ego_displaces_far_objects():
    far = np.array([50.0, 0.0, 0.0])
    priors = [PriorNoise("gaussian_all", 0.0, 1.0).make_prior(far, n).pose for n in range(300)]
    assert np.std([c[1] for c in priors]) == pytest.approx(50 * math.radians(1.0), rel=0.15)


@pytest.mark.parametrize("kind", NOISE_KINDS)
def test_every_kind_makes_a_prior_but_none(kind):
    prior = PriorNoise(kind, 0.5, 0.5).make_prior(TRUTH, 0, 3)
    assert (prior is None) == (kind == "none")


def test_an_offset_is_five_of_what_is_stated_in_any_direction():
    found = np.array([PriorNoise("offset", 0.4, 1.0).make_prior(TRUTH, "drive/7", n).pose - TRUTH for n in range(20)])
    np.testing.assert_allclose(np.hypot(*found[:, :2].T), 2.0)
    assert len(np.unique(np.sign(found[:, :2]), axis=0)) == 4 and np.abs(found[:, 2]).max() < 1e-12
    assert PriorNoise("offset", 0.4, 1.0).make_prior(TRUTH, 0).covariance[0, 0] == pytest.approx(0.16)


def test_conflicts_are_counted_over_all_frames():
    frames = [frame(), frame(PoseStatus.CONFLICT), frame(PoseStatus.NO_MATCH), frame(PoseStatus.OK)]
    assert summarize_evaluations(frames).conflict_rate == 0.25


def test_an_unknown_kind_lists_the_known():
    with pytest.raises(ConfigError, match="heavy, offset, unknown, none"):
        PriorNoise("pink")
