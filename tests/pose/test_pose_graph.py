# SPDX-License-Identifier: Apache-2.0
import itertools
import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import ConfigError, Transform
from manyeyes.ops.se2 import between
from manyeyes.pose.pose_graph import RelativePoseEdge, cycle_distance, optimize_poses, reject_inconsistent_edges
from manyeyes.pose.types import PosePrior, pose_difference

PLACES = {0: (0, 0, 0.0), 1: (30, 5, 2.0), 2: (-10, 25, -1.0), 3: (12, -18, 0.5), 4: (40, -20, 3.0)}
SIGMA = np.array([0.1, 0.1, 0.005])


def make_edge(i, j, noise=None, sigma=SIGMA):
    pose = between(*(torch.tensor(PLACES[a], dtype=torch.float64) for a in (i, j))).numpy()
    return RelativePoseEdge(i, j, pose + (0 if noise is None else noise), np.diag(sigma**2))


def make_edges(agents=5, seed=None):
    rng = np.random.default_rng(seed or 0)
    return [
        make_edge(i, j, rng.standard_normal(3) * SIGMA if seed is not None else None)
        for i, j in itertools.combinations(range(agents), 2)
    ]


def make_prior(agent, sigma=0.5):
    x, y, yaw = PLACES[agent]
    return PosePrior.of(Transform.from_xyz_yaw(x, y, 0.0, yaw), sigma, 0.01)


def test_exact_edges_give_exact_poses_in_any_order():
    all_ = make_edges()
    for listed in (all_, all_[::-1]):
        found = optimize_poses(0, listed, {})
        assert not found.rejected_edges and not found.isolated
        for agent, place in PLACES.items():
            np.testing.assert_allclose(pose_difference(found.pose[agent], np.array(place)), 0, atol=1e-9)


def test_cycle_distance_does_not_depend_on_start_or_direction():
    one, two, three = make_edge(0, 1, np.array([0.5, 0.0, 0.0])), make_edge(1, 2), make_edge(0, 2)
    lengths = [cycle_distance(*order) for order in itertools.permutations((one, two, three))]
    assert max(lengths) == pytest.approx(min(lengths), rel=0.05) and min(lengths) > 1.0
    assert cycle_distance(make_edge(0, 1), make_edge(1, 2), make_edge(0, 2)) == pytest.approx(0.0, abs=1e-18)


def test_fused_covariance_is_below_that_of_the_best_edge():
    found = optimize_poses(0, make_edges(seed=3), {})
    for agent in range(1, 5):
        assert found.covariance[agent][0, 0] < SIGMA[0] ** 2
        error = pose_difference(found.pose[agent], np.array(PLACES[agent], float))
        assert error @ np.linalg.solve(found.covariance[agent], error) < 16.3


def test_one_outlier_edge_is_rejected_and_the_rest_kept():
    listed = [n for n in make_edges(seed=1) if (n.i, n.j) != (1, 3)] + [make_edge(1, 3, np.array([4.0, 0.0, 0.0]))]
    found = optimize_poses(0, listed, {})
    assert [(n.i, n.j) for n in found.rejected_edges] == [(1, 3)]
    np.testing.assert_allclose(found.pose[3][:2], PLACES[3][:2], atol=0.5)


def test_an_agent_with_inconsistent_edges_is_isolated():
    listed = [n for n in make_edges(seed=2) if 4 not in (n.i, n.j)]
    # Agent 4's edges each give another position.
    listed += [make_edge(i, 4, np.array([3.0 * i + 3.0, -5.0 * (i % 2), 0.3 * i])) for i in range(4)]
    found = optimize_poses(0, listed, {})
    assert found.isolated == (4,) and {(n.i, n.j) for n in found.rejected_edges} == {(i, 4) for i in range(4)}
    assert 4 not in found.pose


@pytest.mark.parametrize("outlier", [(0, 1), (0, 2), (1, 2)])
def test_in_a_single_triangle_priors_decide_which_edge_is_the_outlier(outlier):
    listed = [
        make_edge(i, j, np.array([3.0, 0.0, 0.1]) if (i, j) == outlier else None) for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    found = optimize_poses(0, listed, {1: make_prior(1), 2: make_prior(2)})
    assert [(n.i, n.j) for n in found.rejected_edges] == [outlier]
    for agent in (1, 2):
        np.testing.assert_allclose(pose_difference(found.pose[agent], np.array(PLACES[agent], float)), 0, atol=0.05)


def test_priors_place_agents_that_no_edge_reaches_and_weigh_little_elsewhere():
    found = optimize_poses(0, [make_edge(0, 1)], {1: make_prior(1, 5.0), 2: make_prior(2)})
    np.testing.assert_allclose(found.pose[2], PLACES[2], atol=1e-9)
    assert found.covariance[1][0, 0] == pytest.approx(1 / (1 / 0.1**2 + 1 / 5.0**2), rel=1e-3)
    assert set(optimize_poses(0, [make_edge(1, 2)], {}).pose) == {0}
    assert set(optimize_poses(0, [make_edge(1, 2)], {1: make_prior(1)}).pose) == {0, 1, 2}


def test_two_agents_have_no_cycle_to_fail():
    kept, rejected = reject_inconsistent_edges([make_edge(0, 1, np.array([50.0, 0, 0]))], 16.3)
    assert len(kept) == 1 and not rejected


def _reject_one_by_one(edges, max_cycle_chi2):
    """As reject_inconsistent_edges without an agent of rejected edges alone, all triples tried again after each rejection."""
    kept, rejected = list(edges), []
    while True:
        failing, closing = [0.0] * len(kept), [0] * len(kept)
        for triple in itertools.combinations(range(len(kept)), 3):
            pairs = {frozenset((kept[n].i, kept[n].j)) for n in triple}
            if len(pairs) == 3 and len(frozenset().union(*pairs)) == 3:
                length = cycle_distance(*(kept[n] for n in triple))
                for n in triple:
                    failing[n] += min(length / max_cycle_chi2, 1e3) if length > max_cycle_chi2 else 0.0
                    closing[n] += length <= max_cycle_chi2
        bad = [n for n in range(len(kept)) if failing[n] > 0]
        if not bad:
            return kept, rejected
        rejected.append(kept.pop(max(bad, key=lambda n: (-closing[n], round(failing[n], 9), -n))))


@pytest.mark.parametrize("seed", range(12))
def test_rejections_equal_those_of_the_slow_twin(seed):
    rng = np.random.default_rng(seed)
    listed = [
        make_edge(*((i, j) if rng.random() < 0.5 else (j, i)), rng.standard_normal(3) * SIGMA * rng.choice([1, 60]))
        for i, j in [*itertools.combinations(PLACES, 2), (0, 1), (2, 3)]
        if rng.random() < 0.9
    ]
    found, slow = reject_inconsistent_edges(listed, 16.3), _reject_one_by_one(listed, 16.3)
    kept, rejected, slow_kept, slow_rejected = ([id(edge) for edge in part] for part in (*found, *slow))
    assert slow_rejected, "a case without rejections tests nothing"
    # The last edges of an agent that rejected ones contradict come after those.
    assert rejected[: len(slow_rejected)] == slow_rejected
    assert kept == [n for n in slow_kept if n not in rejected] and sorted(kept + rejected) == sorted(map(id, listed))


def test_gtsam_finds_the_same_poses():
    gtsam = pytest.importorskip("gtsam", reason="gtsam is a test oracle only")
    listed = make_edges(seed=5)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(0, 0, 0), gtsam.noiseModel.Constrained.All(3)))
    for n in listed:
        c, s = math.cos(n.pose[2]), math.sin(n.pose[2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        model = gtsam.noiseModel.Gaussian.Covariance(turn @ n.covariance @ turn.T + 1e-8 * np.eye(3))
        graph.add(gtsam.BetweenFactorPose2(n.i, n.j, gtsam.Pose2(*n.pose), model))
    for a, p in PLACES.items():
        start.insert(a, gtsam.Pose2(*map(float, p)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    ours = optimize_poses(0, listed, {}, huber=1e6)
    for a in PLACES:
        there = found.atPose2(a)
        np.testing.assert_allclose(
            pose_difference(ours.pose[a], np.array([there.x(), there.y(), there.theta()])), 0, atol=1e-6
        )


def test_a_link_to_itself_is_refused():
    with pytest.raises(ConfigError, match="joins two agents"):
        RelativePoseEdge(1, 1, np.zeros(3), np.eye(3))
