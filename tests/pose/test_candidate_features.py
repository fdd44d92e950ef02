# SPDX-License-Identifier: Apache-2.0
"""Features of candidate poses: what they do not depend on, and hand-made cases of pairs, overlaps and lanes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.pose.candidate_features import FEATURES, compute_features
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import Candidate, find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene


def make_landmarks(*rows: tuple[float, float, float]) -> Landmarks:
    """Cars at x, y (m), yaw (degrees)."""
    planar = np.array([(x, y, math.radians(yaw), 4.5, 1.9, 0.9) for x, y, yaw in rows])
    return Landmarks.of(planar)


def make_candidate(pose: tuple[float, float, float], *pairs: tuple[int, int], score: float = 20.0) -> Candidate:
    return Candidate(np.array(pose), np.eye(3), np.array(pairs, np.int64).reshape(-1, 2), score, 0.0, 3)


def describe(ego: Landmarks, other: Landmarks, *found: Candidate) -> dict[str, float]:
    features, _ = compute_features(ego, other, found, 1)
    return dict(zip(FEATURES, features[0].tolist()))


@pytest.fixture
def scene() -> tuple[Landmarks, Landmarks, list[Candidate]]:
    made = make_landmark_scene(LandmarkSpec(5, 8, 10, REAL_BOXES), 3, 4)
    ego, other = Landmarks.of_boxes(made.ego[0]), Landmarks.of_boxes(made.other[0])
    return ego, other, find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def invert(a: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def test_the_frames_of_the_agents_do_not_matter(scene) -> None:
    ego, other, found = scene
    there, elsewhere = np.array([12.0, -7.0, 2.1]), np.array([-3.0, 25.0, -0.8])
    moved = [replace(one, pose=compose(compose(there, one.pose), invert(elsewhere))) for one in found]
    wanted, _ = compute_features(ego, other, found, 3)
    features, _ = compute_features(ego.transform(there), other.transform(elsewhere), moved, 3)
    np.testing.assert_allclose(features, wanted, atol=1e-4)


def test_the_order_of_boxes_does_not_matter_and_either_agent_may_be_the_ego(scene) -> None:
    ego, other, found = scene
    wanted, exists = compute_features(ego, other, found, 3)
    order = np.random.default_rng(1).permutation(len(ego))
    place = np.argsort(order)
    shuffled = [replace(one, pairs=np.stack((place[one.pairs[:, 0]], one.pairs[:, 1]), 1)[::-1]) for one in found]
    np.testing.assert_allclose(compute_features(ego[order], other, shuffled, 3)[0], wanted, atol=1e-4)
    swapped = [replace(one, pose=invert(one.pose), pairs=one.pairs[:, ::-1]) for one in found]
    np.testing.assert_allclose(compute_features(other, ego, swapped, 3)[0], wanted, atol=1e-4)
    assert exists.all()


def test_missing_candidates_do_not_exist() -> None:
    ego = make_landmarks((0, 0, 0), (20, 3.5, 0))
    features, exists = compute_features(ego, ego, [make_candidate((0, 0, 0), (0, 0), (1, 1))], 3)
    assert exists.tolist() == [True, False, False] and not features[1:].any()


def test_exact_pairs_have_more_evidence_than_displaced_ones_and_a_turned_heading_is_counted() -> None:
    ego = make_landmarks((0, 0, 0), (20, 3.5, 0), (5, 30, 90))
    exact = describe(ego, ego, make_candidate((0, 0, 0), (0, 0), (1, 1), (2, 2)))
    displaced = describe(ego, ego, make_candidate((0.6, 0, 0.1), (0, 0), (1, 1), (2, 2)))
    for name in ("sum of log-likelihood ratios of positions", "sum of log-likelihood ratios of headings"):
        assert exact[name] > displaced[name] + 1
    turned = make_landmarks((0, 0, 180), (20, 3.5, 0), (5, 30, 90))
    found = describe(ego, turned, make_candidate((0, 0, 0), (0, 0), (1, 1), (2, 2)))
    assert found["pairs whose headings differ by pi"] == 1 and exact["pairs whose headings differ by pi"] == 0
    # A residual far out costs a bounded amount.
    far = describe(ego, ego, make_candidate((9.0, 0, 0), (0, 0), (1, 1), (2, 2)))
    assert far["smallest of them"] == pytest.approx(math.log(1e-9), abs=0.1)


def test_a_queue_is_one_lane_and_crossing_roads_are_two() -> None:
    queue = make_landmarks((0, 0, 0), (8, 0.2, 0), (16, -0.1, 0))
    one = describe(queue, queue, make_candidate((0, 0, 0), (0, 0), (1, 1), (2, 2)))
    assert one["distinct lanes of pairs"] == 1 and one["pairs across a pair, mean"] == 0
    assert one["pairs in the lane of a pair, mean"] == 2
    roads = make_landmarks((0, 0, 0), (8, 0.2, 0), (20, 30, 90))
    two = describe(roads, roads, make_candidate((0, 0, 0), (0, 0), (1, 1), (2, 2)))
    assert two["distinct lanes of pairs"] == 2 and two["pairs across a pair, mean"] == pytest.approx(4 / 3)


def test_unpaired_boxes_overlap_stand_too_close_or_in_lanes() -> None:
    ego = make_landmarks((0, 0, 0), (20, 0, 0))
    overlapping = describe(ego, make_landmarks((0, 0, 0), (22, 0.3, 0)), make_candidate((0, 0, 0), (0, 0)))
    assert overlapping["overlaps of unpaired boxes"] == 1
    assert overlapping["log of the overlaps"] == pytest.approx(math.log(2))
    close = describe(ego, make_landmarks((0, 0, 0), (25, 0.3, 0)), make_candidate((0, 0, 0), (0, 0)))
    assert close["unpaired boxes too close in a lane"] == 1 and close["overlaps of unpaired boxes"] == 0
    paired = describe(ego, ego, make_candidate((0, 0, 0), (0, 0), (1, 1)))
    assert paired["overlaps of unpaired boxes"] == 0 and paired["parallel unpaired boxes"] == 0
    same = describe(ego, make_landmarks((0, 0, 0), (50, 0.1, 0)), make_candidate((0, 0, 0), (0, 0)))
    beside = describe(ego, make_landmarks((0, 0, 0), (50, 1.8, 0)), make_candidate((0, 0, 0), (0, 0)))
    against = describe(ego, make_landmarks((0, 0, 0), (50, 0.1, 180)), make_candidate((0, 0, 0), (0, 0)))
    name = "log fraction of lateral distances below 0.6 m"
    assert same[name] > beside[name] and same[name] == against[name]
    name = "fraction with equal directions in a lane"
    assert same[name] > beside[name] > against[name]


def test_the_margin_is_over_the_best_other_candidate() -> None:
    ego = make_landmarks((0, 0, 0), (20, 3.5, 0))
    found = [make_candidate((0, 0, 0), (0, 0), (1, 1), score=s) for s in (21.0, 18.0, 15.0)]
    features, _ = compute_features(ego, ego, found, 2)
    assert features[:, FEATURES.index("margin over the best other candidate")].tolist() == [3.0, -3.0]
    assert features[0, FEATURES.index("score per pair")] == 10.5
    assert features[0, FEATURES.index("log of the number of compared boxes")] == pytest.approx(math.log(4))
