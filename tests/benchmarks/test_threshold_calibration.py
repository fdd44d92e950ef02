# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest
from benchmarks.threshold_calibration import calibrate_acceptance

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import AcceptanceTest, CorrectorConfig, correct_by_voting
from manyeyes.pose.landmarks import Landmarks
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene

ANY_MARGIN = AcceptanceTest(min_margin=0.0, min_pairs=1, runner_up_margin_pairs=0.0)


def null_scenes(count):
    for n in range(count):
        scene = make_landmark_scene(LandmarkSpec(0, 12, 14, disjoint=True), 3, n)
        yield Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0])


def test_exactly_the_allowed_fraction_is_accepted_and_one_more_below_the_limit():
    pairs = list(null_scenes(20))
    limit = calibrate_acceptance(pairs, 0.1, CorrectorConfig(accept=ANY_MARGIN))
    answers = [correct_by_voting(*p, None, CorrectorConfig(accept=limit)).status.has_estimate for p in pairs]
    assert sum(answers) == 2
    looser = replace(limit, min_score=limit.min_score - 1e-6)
    assert sum(correct_by_voting(*p, None, CorrectorConfig(accept=looser)).status.has_estimate for p in pairs) == 3


def test_a_rate_too_small_for_the_number_of_scenes_raises():
    with pytest.raises(ConfigError, match="at least 400 null scenes"):
        calibrate_acceptance(null_scenes(2), 0.005)
