# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from benchmarks.multi_frame import TimedLandmarks, accumulate

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import correct_by_voting
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseStatus, pose_difference
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene


def test_an_earlier_landmark_moves_with_its_agent_and_its_sigma_grows():
    seen = Landmarks(
        np.array([[10.0, 0.0]]), *np.zeros((1, 1)), np.array([[4.5, 1.9]]), np.ones(1), np.array([0.3]), np.array([0.04]),
        np.array([0.03]), np.zeros(1, np.int64),
    )  # fmt: skip
    carried = accumulate([TimedLandmarks(seen, 2, np.array([-3.0, 1.0, np.pi / 2]), 0.4, 0.03)])
    np.testing.assert_allclose(carried.xy, [[-3.0, 11.0]], atol=1e-12)
    assert carried.instant[0] == 2 and carried.yaw[0] == pytest.approx(np.pi / 2)
    assert carried.sigma_xy[0] == pytest.approx(np.sqrt(0.3**2 + 0.4**2 + 0.3**2))
    assert carried.sigma_yaw[0] == pytest.approx(0.05)


def both(scene):
    return [
        accumulate([TimedLandmarks(Landmarks.of_boxes(b), n, then[n]) for n, b in enumerate(boxes)])
        for boxes, then in ((scene.ego, scene.ego_from_then), (scene.other, scene.other_from_then))
    ]


def test_five_frames_match_where_one_does_not():
    scene = make_landmark_scene(LandmarkSpec(3, 6, 6, num_instants=5), 4, 1)
    one = correct_by_voting(Landmarks.of_boxes(scene.ego[0]), Landmarks.of_boxes(scene.other[0]), None)
    five = correct_by_voting(*both(scene), None)
    assert one.status is PoseStatus.NO_MATCH and five.status is PoseStatus.CORRECTED
    error = pose_difference(five.pose, scene.ego_from_other)
    assert np.hypot(*error[:2]) < 1.0 and abs(error[2]) < 0.0175


def test_objects_of_different_instants_are_never_paired():
    ego, other = both(make_landmark_scene(LandmarkSpec(4, 3, 3, num_instants=3), 4, 2))
    found = correct_by_voting(ego, other, None)
    assert len(found.pairs) and (ego.instant[found.pairs[:, 0]] == other.instant[found.pairs[:, 1]]).all()


def test_a_motion_that_is_not_finite_raises():
    with pytest.raises(ConfigError, match="now_from_then"):
        TimedLandmarks(Landmarks.empty(), 0, np.array([np.nan, 0.0, 0.0]))
