# SPDX-License-Identifier: Apache-2.0
"""Each baseline on a layout small enough to work by hand.

    y
    |  A (2, 10)              five boxes of different lengths, headings as drawn in YAW;
D (-12, 4)                    the other agent stands at (0.6, -0.4), turned by 0.02 rad,
    +-------------- B (20, 0) x      and its prior is the origin.
    |     C (5, -15)     E (16, -9)
"""

from functools import partial

import numpy as np
import pytest

from manyeyes.datatypes import Transform
from manyeyes.pose.baselines import coalign, feaco, fpv_rcnn, icp, identity, mash, v2x_reg, vips
from manyeyes.pose.baselines.v2x_reg import V2xRegConfig
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference

PLACES = np.array([(2, 10), (20, 0), (5, -15), (-12, 4), (16, -9)], float)
YAW = np.array([0.3, 1.2, -0.4, 2.0, 0.0])
TRUTH = np.array([0.6, -0.4, 0.02])
ORIGIN = PosePrior.of(Transform.identity(), 0.5, 0.02)
NEEDS_A_PRIOR = {"coalign": coalign.correct, "fpv_rcnn": fpv_rcnn.correct, "feaco": feaco.correct, "icp": icp.correct}
NEEDS_NONE = {
    "oDist": v2x_reg.correct,
    "oIoU": partial(v2x_reg.correct, config=V2xRegConfig("oIoU")),
    "vips": vips.correct,
    "mash": mash.correct,
}


def layout(places=PLACES, yaw=YAW):
    n = len(places)
    size = np.column_stack((4.0 + 0.7 * np.arange(n), np.full(n, 1.9)))
    ones = np.ones(n)
    return Landmarks(places, yaw, size, ones, 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(n, np.int64))


def seen_from(pose, marks):
    back = Transform.from_xyz_yaw(*map(float, (pose[0], pose[1], 0.0, pose[2]))).inverse()
    return marks.transform(np.array([*back.translation[:2].tolist(), float(back.yaw)]))


@pytest.mark.parametrize("name", [*NEEDS_A_PRIOR, *NEEDS_NONE])
def test_the_layout_of_the_module_docstring(name):
    ego = layout()
    found = (NEEDS_A_PRIOR | NEEDS_NONE)[name](ego, seen_from(TRUTH, ego), ORIGIN)
    assert found.status is PoseStatus.CORRECTED
    np.testing.assert_allclose(pose_difference(found.pose, TRUTH), 0, atol=1e-6)
    assert (found.pairs[:, 0] == found.pairs[:, 1]).all() and found.inliers == 5
    # Five places at 0.25 m on both sides: the middle of them is known to 0.354 / sqrt(5) m.
    assert np.linalg.inv(found.covariance)[0, 0] == pytest.approx(5 / (2 * 0.25**2))


@pytest.mark.parametrize("name", NEEDS_A_PRIOR)
def test_local_methods_need_a_prior(name):
    ego = layout()
    assert NEEDS_A_PRIOR[name](ego, seen_from(TRUTH, ego), None).status is PoseStatus.NO_MATCH


@pytest.mark.parametrize("name", NEEDS_NONE)
def test_global_methods_find_any_pose(name):
    ego, far = layout(), np.array([30.0, 12.0, 2.0])
    found = NEEDS_NONE[name](ego, seen_from(far, ego), None)
    np.testing.assert_allclose(pose_difference(found.pose, far), 0, atol=1e-6)


@pytest.mark.parametrize("name", [*NEEDS_A_PRIOR, *NEEDS_NONE])
def test_without_landmarks_there_is_no_match(name):
    found = (NEEDS_A_PRIOR | NEEDS_NONE)[name](layout(), Landmarks.empty(), ORIGIN)
    assert found.status is PoseStatus.NO_MATCH
    np.testing.assert_allclose(found.pose, 0, atol=1e-12)


def test_identity_keeps_the_prior():
    assert identity.correct(layout(), Landmarks.empty(), ORIGIN).status is PoseStatus.OK
    assert identity.correct(layout(), layout(), None).ego_from_other is None


def test_coalign_needs_four_objects_and_cannot_reach_past_its_clusters():
    ego = layout()
    three = ego[np.arange(3)]
    assert coalign.correct(three, seen_from(TRUTH, three), ORIGIN).status is PoseStatus.NO_MATCH
    assert coalign.correct(ego, seen_from(np.array([2.0, 0.0, 0.0]), ego), ORIGIN).status is PoseStatus.NO_MATCH


def test_coalign_averages_two_agents_of_equal_information():
    # One object is 0.4 m off in x: each of five pairs pulls alike, so the pose is off by a fifth of it, but for a turn.
    ego = layout(yaw=np.zeros(5))
    other = layout(PLACES + np.array([(0.4, 0), (0, 0), (0, 0), (0, 0), (0, 0)]), np.zeros(5))
    assert coalign.correct(ego, other, ORIGIN).pose[0] == pytest.approx(-0.08, abs=0.02)


def test_coalign_matches_boxes_turned_by_pi():
    ego = layout()
    turned = seen_from(TRUTH, layout(yaw=YAW + np.pi * np.array([1, 0, 0, 0, 0])))
    np.testing.assert_allclose(pose_difference(coalign.correct(ego, turned, ORIGIN).pose, TRUTH), 0, atol=1e-6)


def test_fpv_rcnn_cannot_leave_its_grid_and_needs_a_score_of_ten():
    ego = layout()
    assert fpv_rcnn.correct(ego, seen_from(np.array([3.0, 0.0, 0.0]), ego), ORIGIN).status is PoseStatus.NO_MATCH
    four = ego[np.arange(4)]
    assert fpv_rcnn.correct(four, seen_from(TRUTH, four), ORIGIN).status is PoseStatus.NO_MATCH


def test_feaco_rejects_by_the_median_deviation_and_accepts_one_pair():
    # Costs 1, 1.125, 0.875, 1, 4: the median is 1, the median deviation 0.125; the last goes.
    ego = layout(yaw=np.zeros(5))
    shift = np.array([1.0, 1.125, 0.875, 1.0, 4.0])[:, None] * [1.0, 0.0]
    pairs = feaco._assign(ego.xy, ego.xy + shift, feaco.FeacoConfig())
    assert set(pairs[:, 0]) == {0, 1, 2, 3}
    one = ego[np.array([1])]
    found = feaco.correct(one, one.transform(np.array([-2.0, 1.0, 0.0])), ORIGIN)
    np.testing.assert_allclose(found.pose, [2.0, -1.0, 0.0], atol=1e-9)


def test_v2x_reg_fails_where_headings_are_turned():
    ego = layout()
    turned = seen_from(TRUTH, layout(yaw=YAW + np.pi))
    found = v2x_reg.correct(ego, turned, None)
    assert found.pose is None or abs(pose_difference(found.pose, TRUTH)[2]) > 1.0


def test_vips_affinities_by_hand():
    ego = layout()[np.arange(2)]
    other = layout(PLACES + np.array([(0, 0), (3, 0), (0, 0), (0, 0), (0, 0)]))[np.arange(2)]
    found = vips.compute_affinities(ego, other, ORIGIN)
    assert found[0, 0] == pytest.approx(1.0)
    assert found[3, 3] == pytest.approx(np.exp(-0.3))
    assert found[1, 1] == pytest.approx(np.exp(-0.5 * 0.49) * np.exp(-0.1 * np.hypot(21, 10)))
    stretch = np.hypot(21, 10) - np.hypot(18, 10)
    assert found[0, 3] == pytest.approx(np.exp(-0.5 * stretch**2))
    # The same two objects with their names exchanged: lengths agree, the sine of the turn changes its sign.
    assert found[1, 2] == pytest.approx(np.exp(-0.5 * stretch**2) * np.exp(-0.1 * 2 * np.sin(0.9)))
    assert found[0, 1] == found[0, 2] == 0.0
