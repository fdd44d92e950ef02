# SPDX-License-Identifier: Apache-2.0
"""The default corrector on boxes with the measured errors: densities, sensor-fixed clutter, sizes, covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, AcceptanceTest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.sensor_clutter import IdentityFilter, find_sensor_fixed
from manyeyes.pose.size_evidence import SIGMA_SIZE_M, compute_size_evidence
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference
from manyeyes.pose.voting import VoteConfig, find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, SensorClutter, make_landmark_scene

CORRECT = load_corrector("voting")
EXACT_PRIOR = 0.05, math.radians(0.1)


def observe(spec: LandmarkSpec, scene: int) -> tuple[Landmarks, Landmarks, np.ndarray]:
    made = make_landmark_scene(spec, 31, scene)
    return Landmarks.of_boxes(made.ego[0]), Landmarks.of_boxes(made.other[0]), made.ego_from_other


def error_m(pose: np.ndarray, truth: np.ndarray) -> float:
    return float(np.hypot(*pose_difference(pose, truth)[:2]))


def test_sparse_scenes_are_answered_and_dense_nulls_are_not() -> None:
    sparse = [observe(LandmarkSpec(5, 8, 10, REAL_BOXES), n) for n in range(8)]
    found = [CORRECT(ego, other, None) for ego, other, _ in sparse]
    answered = [(f.pose, truth) for f, (_, _, truth) in zip(found, sparse) if f.status.has_estimate]
    assert len(answered) >= 6 and all(error_m(pose, truth) < 2.0 for pose, truth in answered)
    for n in range(6):
        ego, other, _ = observe(LandmarkSpec(0, 40, 50, REAL_BOXES, disjoint=True), n)
        assert not CORRECT(ego, other, None).status.has_estimate


def test_required_score_grows_with_the_number_of_compared_pairs() -> None:
    accept = AcceptanceTest(min_score=5.0, score_per_log_pair=2.0, extra_score_per_instant=3.0)
    assert accept.required_score(1) == 5.0
    assert accept.required_score(100, 3) == pytest.approx(5.0 + 2.0 * math.log(100) + 6.0)
    with pytest.raises(ConfigError, match="score_per_log_pair"):
        AcceptanceTest(score_per_log_pair=-1.0)


def test_compared_pairs_are_of_one_instant() -> None:
    ego, other, _ = observe(LandmarkSpec(8, 2, 2), 0)
    assert find_candidates(ego, other, VoteConfig())[0].num_compared == 100
    halves = [
        replace(side, instant=np.arange(len(ego)) % 2) for side in (ego, ego.transform(np.array([9.0, 3.0, 0.5])))
    ]
    assert find_candidates(*halves, VoteConfig())[0].num_compared == 50


def test_sensor_fixed_clutter_does_not_overturn_an_exact_prior() -> None:
    spec = LandmarkSpec(8, 4, 3, REAL_BOXES, clutter=SensorClutter(80))
    for n in range(2):
        ego, other, truth = observe(spec, n)
        found = CORRECT(ego, other, PosePrior.of(truth, *EXACT_PRIOR))
        assert found.status in (PoseStatus.OK, PoseStatus.CORRECTED)
        unfiltered = replace(DETECTOR_BOXES_CONFIG.vote, identity_filter=IdentityFilter(min_pairs=10**6))
        best = find_candidates(ego, other, unfiltered)[0]
        # Without the filter the identity has far more pairs than the true pose.
        assert np.hypot(*best.pose[:2]) < 1.0 and len(best.pairs) > 60


def test_the_filter_finds_the_clutter_alone_and_exchanging_agents_changes_nothing() -> None:
    ego, other, _ = observe(LandmarkSpec(8, 4, 3, clutter=SensorClutter(40)), 1)
    fixed = find_sensor_fixed(ego, other, IdentityFilter())
    assert fixed is not None
    is_clutter = np.arange(len(ego)) >= 12
    assert (fixed[0] == is_clutter).mean() > 0.95
    back = find_sensor_fixed(other, ego, IdentityFilter())
    assert back is not None and (back[0] == fixed[1]).all() and (back[1] == fixed[0]).all()


@pytest.mark.parametrize("placement", ["beside", "ahead"])
def test_vehicles_beside_and_ahead_are_not_taken_for_clutter(placement: str) -> None:
    for n in range(4):
        ego, other, truth = observe(LandmarkSpec(10, 8, 8, REAL_BOXES, placement=placement), n)
        found = CORRECT(ego, other, None)
        assert found.pose is not None and error_m(found.pose, truth) < 1.0


@pytest.mark.parametrize("scene", [113, 1451])
def test_common_objects_far_behind_both_vehicles_are_not_taken_for_clutter(scene: int) -> None:
    """A turn of two to three degrees cancels the shift of five objects, which coincide in both frames."""
    made = make_landmark_scene(LandmarkSpec(8, 18, 24, REAL_BOXES, placement="beside"), 101, scene)
    ego, other = Landmarks.of_boxes(made.ego[0]), Landmarks.of_boxes(made.other[0])
    found = find_sensor_fixed(ego, other, IdentityFilter(max_variance_ratio=math.inf, min_removed=5))
    assert found is not None and found[0].sum() == 5
    assert find_sensor_fixed(ego, other, IdentityFilter()) is None
    pose = CORRECT(ego, other, None).pose
    assert pose is not None and error_m(pose, made.ego_from_other) < 1.0


@pytest.mark.parametrize("changes", [{"min_removed": 0}, {"max_variance_ratio": 0.0}, {"min_pairs": 0}])
def test_settings_of_the_filter_are_checked(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(changes))):
        IdentityFilter(**changes)


def test_few_boxes_that_coincide_forbid_the_identity_and_are_kept() -> None:
    spec = LandmarkSpec(8, 7, 7, REAL_BOXES, clutter=SensorClutter(5))
    ego, other, truth = observe(spec, 0)
    fixed = find_sensor_fixed(ego, other, IdentityFilter())
    assert fixed is not None and not fixed[0].any() and not fixed[1].any()
    assert not any(
        IdentityFilter().is_identity(one.pose[None])[0]
        for one in find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)
    )
    pose = CORRECT(ego, other, None).pose
    assert pose is not None and error_m(pose, truth) < 1.0


def test_identical_frames_are_matched_with_a_prior_and_not_without() -> None:
    ego, _, _ = observe(LandmarkSpec(8, 8, 8), 2)
    assert CORRECT(ego, ego, None).status is PoseStatus.NO_MATCH
    found = CORRECT(ego, ego, PosePrior.of([0.2, 0.1, 0.0], 0.5, 0.02))
    assert found.status is PoseStatus.OK and found.inliers == len(ego)


def compute_evidence_slowly(a: Landmarks, b: Landmarks, i: int, k: int) -> float:
    def density(x: float, y: float, sigma: float) -> float:
        squared = ((x - y) / sigma) ** 2
        return 0.9 * math.exp(-squared / 2) + 0.1 / 3 * math.exp(-squared / 18) + 1e-12

    total = 0.0
    for axis, sigma in enumerate(SIGMA_SIZE_M):
        x, y = a.size[:, axis], b.size[:, axis]
        by_a = np.mean([density(x[i], other, sigma) for other in y])
        by_b = np.mean([density(other, y[k], sigma) for other in x])
        total += math.log(density(x[i], y[k], sigma)) - math.log(by_a) / 2 - math.log(by_b) / 2
    return total


def test_size_evidence_is_its_definition_and_rare_sizes_are_worth_more() -> None:
    ego, other, _ = observe(LandmarkSpec(6, 4, 5), 0)
    fast = compute_size_evidence(ego, other)
    for i, k in ((0, 0), (3, 7), (9, 10)):
        assert fast[i, k] == pytest.approx(compute_evidence_slowly(ego, other, i, k), abs=1e-9)
    sizes = np.array([[4.5, 1.8]] * 6 + [[11.0, 2.5]])
    marks = Landmarks(np.zeros((7, 2)), *(np.zeros(7),), sizes, *(np.ones(7) for _ in range(4)), np.zeros(7, np.int64))
    evidence = compute_size_evidence(marks, marks)
    assert evidence[6, 6] > evidence[0, 0] + 2.0 and evidence[0, 0] == pytest.approx(0.3, abs=0.2)
    # Equal sizes throughout are no evidence.
    np.testing.assert_allclose(compute_size_evidence(marks[:6], marks[:6]), 0, atol=1e-9)


def test_the_floor_turns_about_the_centre_of_the_pairs() -> None:
    ego, other, _ = observe(LandmarkSpec(8, 2, 2), 3)
    plain = find_candidates(ego, other, VoteConfig())[0]
    floored = find_candidates(ego, other, VoteConfig(floor_xy_m=0.2, floor_yaw_rad=0.01))[0]
    extra = floored.covariance - plain.covariance
    centre = ego.xy[plain.pairs[:, 0]].mean(0)
    # A point of the other's frame that lies at the centre moves by the shift alone.
    arm = centre - plain.pose[:2]
    by = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
    np.testing.assert_allclose(by @ extra @ by.T, 0.04 * np.eye(2), atol=1e-9)
    assert extra[2, 2] == pytest.approx(1e-4)
    few = find_candidates(ego, other, VoteConfig(few_pairs_inflation=4.0))[0]
    np.testing.assert_allclose(few.covariance, plain.covariance * (1 + 4.0 / len(plain.pairs)), rtol=1e-9)
    with pytest.raises(ConfigError, match="floor_xy_m"):
        VoteConfig(floor_xy_m=-1.0)
