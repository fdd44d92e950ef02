# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.pose.metrics import (
    NOISE_KINDS,
    ClaimNoise,
    PoseFrame,
    by_common,
    confusion,
    displacement,
    judged,
    oracle,
    risk_coverage,
    score,
)
from manyeyes.pose.types import PoseStatus, unanswered, upright

TRUTH = np.array([10.0, -4.0, 1.0])
PLACES = np.array([[10.0, 6.0], [20.0, -4.0]])


def frame(status=PoseStatus.CORRECTED, common=5, metres=0.5, degrees=0.5, confidence=1.0, nees=3.0):
    if not status.answered:
        return PoseFrame(status, common, math.inf, math.inf, math.nan, math.nan, -math.inf)
    return PoseFrame(status, common, metres, degrees, metres, nees, confidence)


def test_an_answer_by_hand():
    pose = TRUTH + [3.0, 4.0, math.radians(2.0)]
    said = replace(
        unanswered(None, PoseStatus.CORRECTED),
        ego_from_other=upright(pose, None),
        covariance=np.diag([9.0, 4.0, 1.0]),
        inliers=4,
    )
    found = judged(said, TRUTH, PLACES)
    assert found.metres == pytest.approx(5.0) and found.degrees == pytest.approx(2.0)
    assert found.nees == pytest.approx(1.0 + 4.0 + math.radians(2.0) ** 2)
    assert not found.right(5.0) and found.right(5.01)


def test_an_answer_that_states_no_error_has_no_nees():
    said = replace(unanswered(ClaimNoise().claim(TRUTH, 0)), status=PoseStatus.OK, inliers=4)
    assert math.isnan(judged(said, TRUTH, PLACES).nees)


def test_displacement_by_hand():
    assert displacement(TRUTH + [3.0, 4.0, 0.0], TRUTH, PLACES) == pytest.approx(5.0)
    # Both places are 10 m from the other agent: turned by 0.1 rad about it, each moves by the chord.
    assert displacement(TRUTH + [0.0, 0.0, 0.1], TRUTH, PLACES) == pytest.approx(20 * math.sin(0.05))
    assert math.isnan(displacement(TRUTH, TRUTH, np.zeros((0, 2))))


def test_no_answer_is_a_failure_of_success_and_no_error():
    frames = [
        frame(),
        frame(metres=1.5),
        frame(metres=30.0),
        frame(PoseStatus.NO_MATCH),
        frame(PoseStatus.AMBIGUOUS, common=0),
    ]
    found = score(frames)
    assert found.success == (0.2, 0.4, 0.4)
    assert found.coverage == 0.6 and found.precision == pytest.approx(2 / 3) and found.wrong_accepts == 0.2
    assert found.null_accepts == 0.0 and found.median_metres == 1.5
    assert found.mean_metres == pytest.approx(32 / 3)
    assert score([frame(common=0, metres=9.0)]).null_accepts == 1.0
    assert math.isnan(score([]).coverage)


def test_a_claim_that_is_kept_is_not_an_answer():
    claim = ClaimNoise("gaussian", 0.1, 0.1).claim(TRUTH, 0)
    kept = judged(unanswered(claim), TRUTH, PLACES)
    assert kept.metres < 1 and score([kept]).success[0] == 0.0 and kept.displacement < 1


def test_buckets_split_by_common_objects():
    found = by_common([frame(common=k) for k in (0, 1, 3, 4, 9, 12)])
    assert [(b, s.frames) for b, s in found] == [((0, 0), 1), ((1, 1), 1), ((3, 4), 2), ((8, 10**9), 2)]


def test_honest_covariances_have_nees_three():
    draws = np.random.default_rng(0).standard_normal((4000, 3))
    found = score([frame(nees=float(d @ d)) for d in draws])
    assert found.nees == pytest.approx(3.0, abs=0.1) and found.inside == pytest.approx(0.95, abs=0.01)
    # A chi^2 with three degrees of freedom has variance 6.
    assert found.nees_error == pytest.approx(math.sqrt(6 / len(draws)), rel=0.1)
    assert math.isnan(score([frame()]).nees_error)


def test_risk_falls_with_confidence_and_ties_cannot_be_ordered():
    frames = [frame(metres=9.0, confidence=1.0), frame(confidence=2.0), frame(confidence=3.0)]
    coverage, risk = risk_coverage(frames)
    np.testing.assert_allclose(coverage, [1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(risk, [0, 0, 1 / 3])
    tied = [frame(metres=9.0), frame()]
    for order in (tied, tied[::-1]):
        np.testing.assert_allclose(risk_coverage(order)[1], [0.5, 0.5])


def test_confusion_counts_rows_as_injected():
    table = confusion([(PoseStatus.CONFLICT, PoseStatus.OK), (PoseStatus.CONFLICT, PoseStatus.CONFLICT)])
    assert table[2, 0] == table[2, 2] == 1 and table.sum() == 2


def test_the_oracle_is_right():
    assert judged(oracle(TRUTH, None), TRUTH, PLACES).right(1e-6)


def test_noise_is_paired_over_sizes_and_a_pure_function_of_its_key():
    one, two = (ClaimNoise("gaussian", s, s, seed=1).claim(TRUTH, 4, 2).pose - TRUTH for s in (0.5, 1.0))
    np.testing.assert_allclose(two, 2 * one, atol=1e-12)
    again = ClaimNoise("gaussian", 0.5, 0.5, seed=1).claim(TRUTH, 4, 2).pose - TRUTH
    assert (again == one).all()
    bias = [ClaimNoise("bias", 1.0, 1.0).claim(TRUTH, 3, k).pose for k in (0, 7)]
    assert (bias[0] == bias[1]).all()


@pytest.mark.parametrize("kind, sigma", [("gaussian", 1.0), ("laplace", math.sqrt(2)), ("gaussian_all", math.sqrt(2))])
def test_noise_has_the_size_that_its_claim_states(kind, sigma):
    truth = np.array([0.0, 0.0, 0.3])
    claims = [ClaimNoise(kind, 1.0, 2.0).claim(truth, n) for n in range(400)]
    assert np.std([c.pose[0] for c in claims]) == pytest.approx(sigma, rel=0.15)
    assert math.sqrt(claims[0].covariance[0, 0]) == pytest.approx(sigma, rel=1e-6)


def test_an_error_of_the_egos_yaw_moves_what_is_far():
    far = np.array([50.0, 0.0, 0.0])
    claims = [ClaimNoise("gaussian_all", 0.0, 1.0).claim(far, n).pose for n in range(300)]
    assert np.std([c[1] for c in claims]) == pytest.approx(50 * math.radians(1.0), rel=0.15)


@pytest.mark.parametrize("kind", NOISE_KINDS)
def test_every_kind_makes_a_claim_but_none(kind):
    claim = ClaimNoise(kind, 0.5, 0.5).claim(TRUTH, 0, 3)
    assert (claim is None) == (kind == "none")


def test_an_offset_is_five_of_what_is_stated_in_any_direction():
    found = np.array([ClaimNoise("offset", 0.4, 1.0).claim(TRUTH, "drive/7", n).pose - TRUTH for n in range(20)])
    np.testing.assert_allclose(np.hypot(*found[:, :2].T), 2.0)
    assert len(np.unique(np.sign(found[:, :2]), axis=0)) == 4 and np.abs(found[:, 2]).max() < 1e-12
    assert ClaimNoise("offset", 0.4, 1.0).claim(TRUTH, 0).covariance[0, 0] == pytest.approx(0.16)


def test_conflicts_are_counted_over_all_frames():
    frames = [frame(), frame(PoseStatus.CONFLICT), frame(PoseStatus.NO_MATCH), frame(PoseStatus.OK)]
    assert score(frames).conflicts == 0.25


def test_an_unknown_kind_lists_the_known():
    with pytest.raises(ConfigError, match="heavy, offset, unknown, none"):
        ClaimNoise("pink")
