# SPDX-License-Identifier: Apache-2.0
"""Compiled loops and shortcuts of the voting against references of a few obvious lines."""

import math

import numpy as np
import pytest

from manyeyes.pose import _voting_kernels as loops
from manyeyes.pose.corrector import mahalanobis_squared, prior_log_ratios
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.size_evidence import compute_size_evidence
from manyeyes.pose.types import PosePrior
from manyeyes.pose.voting import (
    Candidate,
    VoteConfig,
    _covariances,
    _hypotheses,
    _numbers,
    _rank_refined,
    _select_supported,
    _with_place_covariance,
    find_candidates,
)
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene

CONFIG = VoteConfig()


def half_turn(angle):
    return math.remainder(angle, math.pi)


def by_x(poses):
    return poses[poses[:, 0].argsort()]


def scene(number=0):
    made = make_landmark_scene(LandmarkSpec(9, 6, 7), 3, number)
    return Landmarks.of_boxes(made.ego[0]), Landmarks.of_boxes(made.other[0])


def compatible(a, b):
    return loops.find_compatible(a.size, b.size, a.instant, b.instant, CONFIG.size_gate_m)


def edge_poses_by_definition(a, b, is_compatible, config):
    """Poses of all pairs of edges within the gate, with their squared residuals: least squares over the turn of the edge."""
    found = []
    pairs = [[(i, j) for i in range(len(x)) for j in range(i + 1, len(x))] for x in (a, b)]
    for i, j in pairs[0]:
        for k, m in [(k, m) for k, m in pairs[1]] + [(m, k) for k, m in pairs[1]]:
            along_a, along_b = a.xy[j] - a.xy[i], b.xy[m] - b.xy[k]
            length_a, length_b = np.hypot(*along_a), np.hypot(*along_b)
            if not all(config.min_edge_m <= n <= config.max_edge_m for n in (length_a, length_b)):
                continue
            if not (is_compatible[i, k] and is_compatible[j, m]):
                continue
            spread = a.sigma_xy[i] ** 2 + a.sigma_xy[j] ** 2 + b.sigma_xy[k] ** 2 + b.sigma_xy[m] ** 2
            turn_ab = math.atan2(along_a[1], along_a[0]) - math.atan2(along_b[1], along_b[0])
            one, two = (half_turn(a.yaw[p] - b.yaw[q] - turn_ab) for p, q in ((i, k), (j, m)))
            weights = np.array(
                [length_a * length_b / spread]
                + [1 / (a.sigma_yaw[p] ** 2 + b.sigma_yaw[q] ** 2) for p, q in ((i, k), (j, m))]
            )
            turn = weights @ [0.0, one, two] / weights.sum()
            misfit = (length_a - length_b) ** 2 / spread + weights @ np.square([turn, one - turn, two - turn])
            if misfit <= config.edge_gate**2:
                yaw = turn_ab + turn
                c, s = math.cos(yaw), math.sin(yaw)
                middle_a, middle_b = (a.xy[i] + a.xy[j]) / 2, (b.xy[k] + b.xy[m]) / 2
                place = middle_a - np.array([[c, -s], [s, c]]) @ middle_b
                found.append((misfit, *place, math.remainder(yaw, 2 * math.pi)))
    return np.array(sorted(found))


def test_hypotheses_are_those_of_all_pairs_of_edges_within_the_gate():
    for number in range(3):
        a, b = scene(number)
        wanted = edge_poses_by_definition(a, b, compatible(a, b), CONFIG)
        assert len(wanted) > 50
        found = _hypotheses(a, b, compatible(a, b), CONFIG)
        np.testing.assert_allclose(by_x(found), by_x(wanted[:, 1:]), atol=1e-9)
        # The best ones are kept where there are too many.
        few = _hypotheses(a, b, compatible(a, b), VoteConfig(max_hypotheses=20))
        np.testing.assert_allclose(by_x(few), by_x(wanted[:20, 1:]), atol=1e-9)


def test_landmarks_of_a_large_error_do_not_hide_edges_of_small_ones():
    a, b = scene()
    a.sigma_xy[0] = b.sigma_xy[-1] = 1.5
    found = _hypotheses(a, b, compatible(a, b), CONFIG)
    wanted = edge_poses_by_definition(a, b, compatible(a, b), CONFIG)
    np.testing.assert_allclose(by_x(found), by_x(wanted[:, 1:]), atol=1e-9)


def support_by_definition(poses, a, b, is_compatible, tau, turn):
    out = []
    for x, y, yaw in poses:
        c, s = np.cos(yaw), np.sin(yaw)
        there = b.xy @ np.array([[c, s], [-s, c]]) + (x, y)
        gain = 1 - ((a.xy[:, None] - there) ** 2).sum(2) / tau**2
        heading = np.abs((a.yaw[:, None] - b.yaw - yaw + np.pi / 2) % np.pi - np.pi / 2)
        out.append(np.where(is_compatible & (heading < turn), gain, 0).clip(min=0).max(0).sum())
    return np.array(out)


@pytest.mark.parametrize("scale", [1.0, 400.0])
def test_support_is_that_of_all_pairs_of_landmarks(scale):
    a, b = scene(1)
    rng = np.random.default_rng(0)
    poses = np.concatenate((_hypotheses(a, b, compatible(a, b), CONFIG), rng.normal(0, 20, (2000, 3))))
    # Cells grow where the landmarks lie far apart.
    far = np.append(a.xy, a.xy[:1] + (scale * 10, -scale * 7), 0)
    a = Landmarks.cat([a, a[:1].transform(np.array([scale * 10, -scale * 7, 0.0]))])
    assert np.array_equal(a.xy, far)
    grid = loops.build_grid(a.xy, 1.5)
    found = loops.compute_support(poses, _numbers(a), _numbers(b), compatible(a, b), grid, 1.5, 0.26)
    wanted = support_by_definition(poses, a, b, compatible(a, b), 1.5, 0.26)
    assert (wanted > 0).sum() > 100
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_few_sorted_hypotheses_select_as_all_of_them_do():
    rng = np.random.default_rng(1)
    middle = np.array([3.0, 4.0])
    # Clusters of alike poses: the first part of the order does not hold enough distinct ones. Equal supports are ordered by pose.
    for spread in (0.01, 30.0):
        poses = rng.normal(0, spread, (3000, 3)) * (1, 1, 0.01) + rng.integers(0, 6, (3000, 1)) * (9.0, 0, 0)
        support = rng.integers(0, 40, 3000) / 4
        config = VoteConfig(max_refined=24)
        order = np.lexsort((*poses.T, -support))
        wanted = loops.select_distinct(poses, order, middle, 24, config.min_separation_m / 2, 0.0525)
        assert np.array_equal(_select_supported(poses, support, middle, config), wanted)
    assert len(_select_supported(np.zeros((0, 3)), np.zeros(0), middle, CONFIG)) == 0


def test_refined_poses_are_ranked_by_the_sum_of_their_pairs_evidence():
    a, b = scene(2)
    is_compatible = compatible(a, b)
    exact = _with_place_covariance(a, 1.0), _with_place_covariance(b, 1.0)
    starts = np.concatenate((_hypotheses(a, b, is_compatible, CONFIG)[::7][:12], [[500.0, 0.0, 0.0]]))
    refined = loops.refine_poses(starts, *exact, is_compatible, 1.0, CONFIG.pair_gate, 14)
    wanted, sizes = [], compute_size_evidence(a, b)
    for start in starts:
        pose, information, pairs, misfit = loops.refine_pose(start, *exact, is_compatible, 1.0, CONFIG.pair_gate, 14)
        score = 0.0
        for (i, k), square in zip(pairs, misfit):
            variance = a.sigma_xy[i] ** 2 + b.sigma_xy[k] ** 2
            gain = math.log(CONFIG.chance_area_m2 / (2 * math.pi * variance)) - square / 2 + sizes[i, k]
            flip_a, flip_b = (min(max(p, 0.01), 0.5) for p in (a.p_flip[i], b.p_flip[k]))
            agree = (1 - flip_a) * (1 - flip_b) + flip_a * flip_b
            same = math.cos(a.yaw[i] - b.yaw[k] - pose[2]) > 0
            score += max(gain, 0.0) + math.log(2 * (agree if same else 1 - agree))
        wanted += [(pose, information, pairs, misfit, score)] if len(pairs) else []
    wanted.sort(key=lambda f: -f[4])
    found = _rank_refined(a, b, refined, CONFIG)
    assert 3 < len(found) == len(wanted) < len(starts)
    for one, two in zip(found, wanted):
        assert one[4] == pytest.approx(two[4], abs=1e-9)
    np.testing.assert_array_equal(found[0][2], wanted[0][2])


def test_a_fitted_pose_has_no_gradient_left():
    a, b = scene()
    best = find_candidates(a, b, CONFIG)[0]
    exact = _with_place_covariance(a, 1.0), _with_place_covariance(b, 1.0)
    pose, information = loops.fit_pose(best.pose, best.pairs, *exact, 12)

    def cost(p):
        c, s = math.cos(p[2]), math.sin(p[2])
        i, k = best.pairs.T
        apart = a.xy[i] - (b.xy[k] @ np.array([[c, s], [-s, c]]) + p[:2])
        heading = (a.yaw[i] - b.yaw[k] - p[2] + np.pi / 2) % np.pi - np.pi / 2
        position = (apart**2).sum(1) / (a.sigma_xy[i] ** 2 + b.sigma_xy[k] ** 2)
        return float((position + heading**2 / (a.sigma_yaw[i] ** 2 + b.sigma_yaw[k] ** 2)).sum()) / 2

    steps = np.diag([1e-4, 1e-4, 1e-6])
    gradient = [(cost(pose + d) - cost(pose - d)) / (2 * d.max()) for d in steps]
    np.testing.assert_allclose(np.linalg.solve(information, gradient), 0, atol=1e-6)


def test_of_alike_poses_the_better_one_stays():
    poses = np.array([[0, 0, 0], [1.9, 0, 0], [2.5, 0, 0], [0, 0, 0.2], [0.5, 0, 2 * np.pi]], float)
    rows = loops.select_separate(poses, np.zeros((5, 2)), 2.0, 0.105)
    assert rows.tolist() == [0, 2, 3]


def test_a_half_turn_wraps_as_the_remainder_does():
    angles = np.concatenate((np.linspace(-12, 12, 401), np.array([-1.5, -1, -0.5, 0, 0.5, 1, 1.5]) * np.pi))
    for angle in angles:
        assert loops.wrap_half_turn(angle) == (angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi


def test_covariances_of_candidates_are_scaled_inverse_information():
    rng = np.random.default_rng(2)
    config = VoteConfig(common_variance_fraction=0.05)
    found = []
    for pairs in (1, 4, 9):
        root = rng.normal(size=(3, 3))
        found.append((np.zeros(3), root @ root.T + np.eye(3), np.zeros((pairs, 2), int), rng.random(pairs) * 5, 1.0))
    for one, covariance in zip(found, _covariances(found, Landmarks.empty(), config)):
        pairs, misfit = len(one[2]), one[3].sum()
        wanted = np.linalg.inv(one[1]) * (10.0 + misfit) / (10.0 + 3 * pairs - 3)
        wanted[0, 0] += 0.05 * pairs * 2 / (one[1][0, 0] + one[1][1, 1])
        wanted[1, 1] += 0.05 * pairs * 2 / (one[1][0, 0] + one[1][1, 1])
        np.testing.assert_allclose(covariance, wanted, rtol=1e-9)


def test_the_prior_raises_scores_by_its_density_over_that_of_a_uniform_pose():
    rng = np.random.default_rng(3)
    prior = PosePrior.of((1.0, 2.0, 3.1), 1.0, 0.05)
    candidates = []
    for turn in (3.1, -3.12, 0.4):
        pose = np.array([1.3, 2.2, turn])
        candidates.append(Candidate(pose, np.diag(rng.random(3) + 0.01), np.zeros((3, 2), int), 9.0, 1.0, 6))
    found = prior_log_ratios(candidates, prior, 2e5)
    for candidate, ratio in zip(candidates, found):
        spread = candidate.covariance + prior.covariance
        density = -(mahalanobis_squared(candidate.pose, candidate.covariance, prior)) / 2
        density -= math.log(math.sqrt(np.linalg.det(2 * np.pi * spread)))
        assert ratio == pytest.approx(max(0.0, density + math.log(2e5)), abs=1e-9)
    assert found[0] > 5 and found[2] < found[0]
    assert prior_log_ratios(candidates, None, 2e5) == [0.0] * 3
