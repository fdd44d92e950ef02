# SPDX-License-Identifier: Apache-2.0
"""The vote with a learned acceptance: shipped weights, priors, frames, and when the vote's own limits hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.models import pretrained
from manyeyes.pose.corrector import DETECTOR_BOXES_CONFIG, decide
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.learned_voting import LearnedVotingConfig, LearnedVotingCorrector, load_learned_voting
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference
from manyeyes.pose.voting import find_candidates
from manyeyes.simulator.fleet.landmark_errors import REAL_BOXES
from manyeyes.simulator.fleet.landmarks import LandmarkScene, LandmarkSpec, make_landmark_scene


def make_scene(num_common: int, number: int, disjoint: bool = False) -> tuple[LandmarkScene, Landmarks, Landmarks]:
    scene = make_landmark_scene(LandmarkSpec(num_common, 8, 10, REAL_BOXES, disjoint=disjoint), 71, number)
    return scene, Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0])


def is_right(estimate, scene: LandmarkScene) -> bool:
    error = pose_difference(estimate.pose, scene.ego_from_other)
    return bool(np.hypot(*error[:2]) < 2.0 and abs(error[2]) < np.radians(2.0))


def test_many_common_objects_are_answered_and_strangers_are_not() -> None:
    correct = load_corrector("learned-voting")
    for number in range(6):
        scene, ego, other = make_scene(8, number)
        estimate = correct(ego, other, None)
        assert estimate.status is PoseStatus.CORRECTED and is_right(estimate, scene)
        assert not correct(*make_scene(0, number, disjoint=True)[1:], None).status.has_estimate


def test_it_answers_more_with_four_common_objects_than_the_vote() -> None:
    learned, vote, answered = load_corrector("learned-voting"), load_corrector("voting"), np.zeros(2, int)
    for number in range(40):
        scene, ego, other = make_scene(4, number)
        estimates = [correct(ego, other, None) for correct in (vote, learned)]
        answered += [e.status.has_estimate for e in estimates]
        assert not estimates[1].status.has_estimate or is_right(estimates[1], scene)
    assert answered[1] >= answered[0] + 6


def test_a_prior_supports_a_candidate_and_a_distant_one_is_a_conflict() -> None:
    scene, ego, other = make_scene(8, 3)
    near = PosePrior.of(scene.ego_from_other + [0.3, 0.2, 0.005], 0.5, 0.02)
    far = PosePrior.of(scene.ego_from_other + [9.0, 0.0, 0.0], 0.5, 0.02)
    correct = load_corrector("learned-voting")
    assert correct(ego, other, near).status is PoseStatus.OK
    conflict = correct(ego, other, far)
    assert conflict.status is PoseStatus.CONFLICT and is_right(conflict, scene)


def test_unusable_landmarks_change_nothing() -> None:
    _, ego, other = make_scene(6, 1)
    broken = replace(ego[:1], xy=np.full((1, 2), np.nan))
    learned = load_learned_voting()
    (first, *_), (again, *_) = (
        learned.judge(x, other, find_candidates(x, other, DETECTOR_BOXES_CONFIG.vote))
        for x in (ego, Landmarks.cat([broken, ego]))
    )
    assert again.score == pytest.approx(first.score, abs=1e-4)
    np.testing.assert_array_equal(again.pairs, first.pairs + [1, 0])


def test_more_boxes_than_in_training_are_judged_by_the_vote() -> None:
    _, ego, other = make_scene(5, 2)
    learned = LearnedVotingCorrector(pretrained.load_pose_verifier(), LearnedVotingConfig(max_landmarks=10))
    found = find_candidates(ego, other, DETECTOR_BOXES_CONFIG.vote)
    wanted = decide(found, None, DETECTOR_BOXES_CONFIG.accept)
    estimate = learned(ego, other, None)
    assert (estimate.status, estimate.margin) == (wanted.status, wanted.margin)


def test_nothing_to_match_is_no_match() -> None:
    _, ego, _ = make_scene(5, 2)
    assert load_corrector("learned-voting")(ego, Landmarks.empty(), None).status is PoseStatus.NO_MATCH
