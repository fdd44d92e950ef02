# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import AcceptanceTest, CorrectorConfig, correct_pose
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.threshold_calibration import calibrate_acceptance
from manyeyes.simulator.fleet.landmark_scenes import LandmarkSpec, make_landmark_scene


def strangers(count):
    for n in range(count):
        scene = make_landmark_scene(LandmarkSpec(0, 12, 14, disjoint=True), 3, n)
        yield Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0])


def test_exactly_the_allowed_share_is_answered_and_a_hair_less_strict_one_more():
    pairs = list(strangers(20))
    limit = calibrate_acceptance(pairs, 0.1, CorrectorConfig(accept=AcceptanceTest(25.0, 0.0, 1, 0.0)))
    answers = [correct_pose(*p, None, CorrectorConfig(accept=limit)).status.has_estimate for p in pairs]
    assert sum(answers) == 2
    looser = replace(limit, min_score=limit.min_score - 1e-6)
    assert sum(correct_pose(*p, None, CorrectorConfig(accept=looser)).status.has_estimate for p in pairs) == 3


def test_a_rate_that_the_scenes_cannot_show_is_refused():
    with pytest.raises(ConfigError, match="at least 400 null scenes"):
        calibrate_acceptance(strangers(2), 0.005)
