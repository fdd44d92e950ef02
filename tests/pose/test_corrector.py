# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.pose.corrector import AcceptanceTest, CorrectorConfig, correct_by_voting, fuse_estimates, rank_candidates
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference
from manyeyes.pose.voting import VoteConfig, find_candidates
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene


def transform(pose):
    return Transform.from_xyz_yaw(float(pose[0]), float(pose[1]), 0.0, float(pose[2]))


def make_prior(pose, sigma=0.5):
    return PosePrior.of(transform(pose), sigma, math.radians(sigma))


def views(common=8, scene=0, ego_extra=8, other_extra=10, **more):
    made = make_landmark_scene(LandmarkSpec(common, ego_extra, other_extra, **more), 11, scene)
    return Landmarks.of_boxes(made.ego[0]), Landmarks.of_boxes(made.other[0]), made


def off(found, truth):
    d = pose_difference(found, truth)
    return float(np.hypot(d[0], d[1])), abs(math.degrees(d[2]))


def row(places, yaw=0.0, sigma=0.1, flip=0.03):
    """Equal cars at places (N, 2)."""
    xy = np.asarray(places, float)
    ones = np.ones(len(xy))
    size = np.column_stack((4.5 * ones, 1.9 * ones))
    return Landmarks(xy, yaw * ones, size, ones, sigma * ones, 0.03 * ones, flip * ones, np.zeros(len(xy), np.int64))


def test_the_pose_is_found_from_nowhere_and_its_pairs_are_the_common_objects():
    for scene in range(4):
        ego, other, made = views(scene=scene)
        found = correct_by_voting(ego, other, None)
        assert found.status is PoseStatus.CORRECTED and found.pose is not None
        assert max(off(found.pose, made.ego_from_other)) < 1.0
        common = set(map(tuple, made.common_pairs))
        assert len(common & set(map(tuple, found.pairs))) >= 7
        assert found.inliers == len(found.pairs) and found.margin > 3


def test_its_own_noise_free_view_is_recovered_exactly():
    ego, _, _ = views()
    pose = np.array([31.0, -12.0, 2.5])
    back = Transform.from_xyz_yaw(31.0, -12.0, 0.0, 2.5).inverse()
    found = correct_by_voting(ego, ego.transform(np.array([*back.translation[:2].tolist(), float(back.yaw)])), None)
    np.testing.assert_allclose(pose_difference(found.pose, pose), 0, atol=1e-9)
    assert found.inliers == len(ego)


def test_nothing_little_and_nothing_in_common_give_no_pose():
    ego, other, _ = views()
    few = np.array([0])
    for one, two in ((Landmarks.empty(), other), (ego, Landmarks.empty()), (ego[few], other[few])):
        assert correct_by_voting(one, two, None).status is PoseStatus.NO_MATCH
    strangers = [views(scene=s, disjoint=True, ego_extra=22, other_extra=28) for s in range(6)]
    for ego, other, _ in strangers:
        found = correct_by_voting(ego, other, None)
        assert not found.status.has_estimate and found.pose is None
        prior = make_prior([5.0, 1.0, 0.3])
        kept = correct_by_voting(ego, other, prior)
        if not kept.status.has_estimate:
            np.testing.assert_allclose(kept.pose, prior.pose)
            np.testing.assert_allclose(kept.covariance, prior.covariance)


def test_an_evenly_spaced_queue_is_ambiguous():
    queue = row([(8.0 * k, 0.02 * k) for k in range(9)])
    found = correct_by_voting(queue, queue.transform(np.array([3.0, 2.0, 0.5])), None)
    assert found.status is PoseStatus.AMBIGUOUS and found.pose is None and found.runner_up >= 8


def test_a_four_way_layout_that_fits_turned_by_pi_is_ambiguous_without_headings_and_not_with_them():
    places = np.array([(20, 3), (33, 3), (45, 7), (-3, 18), (-3, 29), (-7, 41)], float)
    places = np.concatenate((places, -places))
    blind = row(places, flip=0.5)
    assert correct_by_voting(blind, blind.transform(np.array([1.0, 2.0, 0.4])), None).status is PoseStatus.AMBIGUOUS
    seeing = row(places, flip=0.03)
    found = correct_by_voting(seeing, seeing.transform(np.array([0.0, 0.0, 0.4])), None)
    assert found.status is PoseStatus.CORRECTED and max(off(found.pose, [0.0, 0.0, -0.4])) < 1e-6


def test_a_mirrored_scene_is_not_matched_by_a_reflection():
    ego, other, _ = views(common=12)
    mirrored = replace(other, xy=other.xy * [1.0, -1.0], yaw=-other.yaw)
    assert not correct_by_voting(ego, mirrored, None).status.has_estimate


def test_duplicates_and_flipped_headings_do_no_harm():
    ego, other, made = views(common=9)
    twice = Landmarks.cat([other, replace(other, xy=other.xy + 0.3)])
    turned = replace(ego, yaw=ego.yaw + np.pi * (np.arange(len(ego)) % 10 == 0))
    found = correct_by_voting(turned, twice, None)
    assert found.status.has_estimate and max(off(found.pose, made.ego_from_other)) < 1.0
    assert len(set(found.pairs[:, 0])) == len(set(found.pairs[:, 1])) == found.inliers


@pytest.mark.parametrize("metres, degrees", [(5.0, 0.0), (50.0, 0.0), (0.0, 20.0), (3.0, 180.0)])
def test_a_wrong_prior_is_a_conflict_and_not_used(metres, degrees):
    ego, other, made = views()
    wrong = make_prior(made.ego_from_other + [metres, 0.0, math.radians(degrees)])
    found = correct_by_voting(ego, other, wrong)
    assert found.status is PoseStatus.CONFLICT and found.mahalanobis_squared > 16.27
    np.testing.assert_allclose(found.pose, found.measured, atol=1e-12)
    assert max(off(found.pose, made.ego_from_other)) < 1.0


def test_conflict_margin_applies_to_candidates_that_contradict_the_prior():
    ego, other, made = views(common=5, ego_extra=3, other_extra=3)
    wrong = make_prior(made.ego_from_other + np.array([9.0, -6.0, 0.8]))
    plain = correct_by_voting(ego, other, wrong)
    assert plain.status is PoseStatus.CONFLICT
    ranked = rank_candidates(find_candidates(ego, other, VoteConfig(), wrong), wrong, AcceptanceTest().prior_volume)
    for more, status in ((0.9, PoseStatus.CONFLICT), (1.1, PoseStatus.NO_MATCH)):
        enough = more * (ranked.score - AcceptanceTest().required_score(ranked.best.num_compared))
        accept = AcceptanceTest(conflict_margin=enough, min_margin=0.0, runner_up_margin_pairs=0.0)
        asked = correct_by_voting(ego, other, wrong, CorrectorConfig(accept=accept))
        assert asked.status is status
    # A prior that objects agree with needs no such margin.
    right = make_prior(made.ego_from_other)
    much = CorrectorConfig(accept=AcceptanceTest(conflict_margin=1e3))
    assert (
        correct_by_voting(ego, other, right, much).status
        is correct_by_voting(ego, other, right).status
        is PoseStatus.OK
    )
    with pytest.raises(ConfigError, match="conflict_margin"):
        AcceptanceTest(conflict_margin=-1.0)


def test_a_good_prior_is_fused_and_reduces_both_covariances():
    ego, other, made = views()
    prior = make_prior(made.ego_from_other + [0.1, -0.1, 0.002], sigma=0.2)
    found = correct_by_voting(ego, other, prior)
    assert found.status is PoseStatus.OK and found.mahalanobis_squared < 7.82
    for alone in (prior.covariance, found.measured_covariance):
        assert np.linalg.eigvalsh(alone - found.covariance).min() > -1e-12


def test_a_prior_without_error_stays_while_objects_agree():
    ego, other, made = views()
    exact = PosePrior(transform(made.ego_from_other), np.zeros((3, 3)))
    found = correct_by_voting(ego, other, exact)
    if found.status is PoseStatus.OK:
        np.testing.assert_allclose(pose_difference(found.pose, made.ego_from_other), 0, atol=1e-9)
    assert found.status in (PoseStatus.OK, PoseStatus.CORRECTED)


def test_a_prior_allows_an_estimate_from_few_objects():
    ego, other, made = views(common=3, scene=1)
    assert not correct_by_voting(ego, other, None).status.has_estimate
    found = correct_by_voting(ego, other, make_prior(made.ego_from_other, 0.3))
    assert found.status is PoseStatus.OK


def test_height_and_tilt_are_those_of_the_prior():
    ego, other, made = views()
    pose = made.ego_from_other
    tilted = Transform.from_rpy(
        torch.tensor([pose[0], pose[1], 4.0], dtype=torch.float64),
        *torch.tensor([0.02, -0.03, pose[2]], dtype=torch.float64),
    )
    found = correct_by_voting(ego, other, PosePrior.of(tilted, 0.5, 0.01)).ego_from_other
    assert float(found.translation[2]) == 4.0
    up = tilted.rotation[2], found.rotation[2]
    assert float(up[0][2]) == pytest.approx(float(up[1][2]), abs=1e-12)


@pytest.mark.parametrize("lateral_sigma_ratio", [1.0, 0.5])
def test_estimates_are_equivariant_to_frames_order_and_exchange(lateral_sigma_ratio):
    ego, other, _ = views()
    config = CorrectorConfig(VoteConfig(lateral_sigma_ratio=lateral_sigma_ratio))
    found = correct_by_voting(ego, other, None, config)
    step, turn = np.array([4.0, -7.0, 1.1]), np.array([-30.0, 12.0, -2.0])
    moved = correct_by_voting(ego.transform(step), other.transform(turn), None, config)
    wanted = transform(step) @ transform(found.pose) @ transform(turn).inverse()
    np.testing.assert_allclose(moved.ego_from_other.matrix(), wanted.matrix(), atol=1e-6)
    rng = np.random.default_rng(0)
    one, two = rng.permutation(len(ego)), rng.permutation(len(other))
    mixed = correct_by_voting(ego[one], other[two], None, config)
    assert (mixed.pose == found.pose).all() and (mixed.covariance == found.covariance).all()
    assert set(zip(one[mixed.pairs[:, 0]], two[mixed.pairs[:, 1]])) == set(map(tuple, found.pairs))
    back = correct_by_voting(other, ego, None, config)
    np.testing.assert_allclose(back.ego_from_other.matrix(), found.ego_from_other.inverse().matrix(), atol=1e-6)
    assert back.inliers == found.inliers and back.margin == pytest.approx(found.margin, abs=1e-6)


def test_exchanged_agents_have_the_inverse_covariance():
    ego, other, _ = views(common=6, ego_extra=4, other_extra=9)
    one = find_candidates(ego, other, VoteConfig())[0]
    two = find_candidates(other, ego, VoteConfig())[0]
    step = 1e-6

    def inverse(pose):
        t = transform(pose).inverse()
        return np.array([*t.translation[:2].tolist(), float(t.yaw)])

    by = np.stack([(inverse(one.pose + step * e) - inverse(one.pose - step * e)) / (2 * step) for e in np.eye(3)], 1)
    np.testing.assert_allclose(two.covariance, by @ one.covariance @ by.T, rtol=1e-5)


def observe_elongated_errors(count, rng):
    """Cars of all headings seen by two agents, with 0.4 m longitudinal and 0.1 m lateral errors; the relative pose."""
    truth = np.array([20.0, -9.0, 0.7])
    xy, yaw = rng.uniform(-30, 30, (count, 2)), rng.uniform(-3, 3, count)
    there = transform(truth).inverse()
    marks = [replace(row(xy, sigma=0.4), yaw=yaw)]
    marks.append(marks[0].transform(np.array([*there.translation[:2].tolist(), float(there.yaw)])))
    off = []
    for mark in marks:
        longitudinal, lateral = 0.4 * rng.standard_normal(count), 0.1 * rng.standard_normal(count)
        c, s = np.cos(mark.yaw), np.sin(mark.yaw)
        moved = mark.xy + np.column_stack((longitudinal * c - lateral * s, longitudinal * s + lateral * c))
        off.append(replace(mark, xy=moved, yaw=mark.yaw + 0.03 * rng.standard_normal(count)))
    return *off, truth


def test_lateral_sigma_ratio_reduces_the_error_and_the_covariance_is_consistent():
    rng = np.random.default_rng(4)
    errors, nees = {1.0: [], 0.25: []}, []
    for _ in range(120):
        ego, other, truth = observe_elongated_errors(7, rng)
        for across, found in errors.items():
            candidate = find_candidates(ego, other, VoteConfig(lateral_sigma_ratio=across, prior_dof=1e6))[0]
            d = pose_difference(candidate.pose, truth)
            found.append(np.hypot(d[0], d[1]))
            if across < 1:
                nees.append(d @ np.linalg.solve(candidate.covariance, d))
    isotropic, anisotropic = (np.sqrt(np.square(found).mean()) for found in errors.values())
    assert anisotropic < 0.75 * isotropic
    # Of 120 means of three degrees of freedom: 3, one standard error 0.22.
    assert 2.3 < np.mean(nees) < 3.7


def test_invalid_landmarks_are_ignored_and_the_number_is_bounded():
    ego, other, _ = views(common=12)
    junk = replace(other, xy=other.xy.copy(), yaw=other.yaw.copy())
    junk.xy[-1], junk.yaw[-2], junk.xy[-3] = np.nan, np.inf, 1e9
    assert correct_by_voting(ego, junk, None).ego_from_other is not None
    rng = np.random.default_rng(0)
    crowd = row(rng.uniform(-100, 100, (10_000, 2)), flip=0.5)
    crowd = replace(crowd, yaw=rng.uniform(-3, 3, 10_000), score=rng.random(10_000))
    few = CorrectorConfig(VoteConfig(max_landmarks=40))
    assert len(correct_by_voting(crowd, crowd[::-1].transform(np.array([1e3, 0.0, 0.0])), None, few).pairs) <= 40


def test_fusion_weights_by_information_and_wraps_angles():
    tight, loose = np.diag([0.01, 0.01, 0.0001]), np.diag([1.0, 1.0, 0.01])
    pose, covariance = fuse_estimates(np.array([0.0, 0.0, 3.1]), tight, np.array([1.01, 0.0, -3.1]), loose)
    assert pose[0] == pytest.approx(0.01, abs=1e-12)
    assert pose[2] == pytest.approx(3.1 + (2 * math.pi - 6.2) / 101)
    np.testing.assert_allclose(np.linalg.inv(covariance), np.linalg.inv(tight) + np.linalg.inv(loose), rtol=1e-9)
    same, zero = fuse_estimates(np.array([1.0, 2.0, 0.3]), tight, np.array([4.0, 5.0, 0.6]), np.zeros((3, 3)))
    np.testing.assert_allclose(same, [4.0, 5.0, 0.6])
    np.testing.assert_allclose(zero, 0, atol=1e-15)


def test_invalid_settings_and_priors_raise():
    with pytest.raises(ConfigError, match="min_margin"):
        AcceptanceTest(min_margin=-1.0)
    with pytest.raises(ConfigError, match="caps"):
        VoteConfig(max_edges=0)
    with pytest.raises(ConfigError, match="negative variance"):
        PosePrior(Transform.identity(), -np.eye(3))
