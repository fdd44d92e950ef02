# SPDX-License-Identifier: Apache-2.0
"""CoAlign's graph of all agents: exact recovery, ties through a third agent, and what stays with its prior."""

import numpy as np
import pytest

from manyeyes.datatypes import Transform
from manyeyes.pose.baselines import coalign
from manyeyes.pose.baselines.coalign_joint import correct_jointly
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import find_joint_corrector
from manyeyes.pose.types import PosePrior, PoseStatus, pose_difference

PLACES = np.array([(2, 10), (20, 0), (5, -15), (-12, 4), (16, -9), (30, 12)], float)
YAW = np.array([0.3, 1.2, -0.4, 2.0, 0.0, -1.0])
POSES = np.array([(8.0, 3.0, 0.7), (-5.0, 6.0, -2.0)])
ERROR = np.array([0.8, -0.5, np.radians(0.8)])


def layout(rows=slice(None)) -> Landmarks:
    places, yaw = PLACES[rows], YAW[rows]
    ones = np.ones(len(places))
    size = np.column_stack((4.5 * ones, 1.9 * ones))
    return Landmarks(places, yaw, size, ones, 0.25 * ones, 0.04 * ones, 0.03 * ones, np.zeros(len(ones), np.int64))


def seen_from(pose, marks: Landmarks) -> Landmarks:
    back = Transform.from_xyz_yaw(*map(float, (pose[0], pose[1], 0.0, pose[2]))).inverse()
    return marks.transform(np.array([*back.translation[:2].tolist(), float(back.yaw)]))


def prior(pose, error=ERROR) -> PosePrior:
    x, y, yaw = (pose + error).tolist()
    return PosePrior.of(Transform.from_xyz_yaw(x, y, 0.0, yaw), 0.8, 0.02)


def test_poses_are_recovered_exactly_from_boxes_without_noise() -> None:
    """Six objects, two collaborators off by 0.8 m and 0.8 degrees, one of them with its boxes turned by pi."""
    seen = [layout(), seen_from(POSES[0], layout()), seen_from(POSES[1], layout())]
    seen[2].yaw[:] += np.pi
    for found, truth in zip(correct_jointly(seen, [prior(p) for p in POSES]), POSES):
        assert found.status is PoseStatus.CORRECTED and found.inliers == 6 and len(found.pairs) == 6
        np.testing.assert_allclose(pose_difference(found.pose, truth), 0, atol=1e-6)


def test_agents_without_a_common_object_are_tied_through_a_third() -> None:
    """The ego sees objects 0 to 2, the last agent 3 to 5, and the agent between them all."""
    seen = [layout(slice(3)), seen_from(POSES[0], layout()), seen_from(POSES[1], layout(slice(3, None)))]
    near, far = correct_jointly(seen, [prior(p) for p in POSES])
    for found, truth in ((near, POSES[0]), (far, POSES[1])):
        np.testing.assert_allclose(pose_difference(found.pose, truth), 0, atol=1e-6)
    assert len(near.pairs) == 3 and len(far.pairs) == 0 and far.inliers == 3
    assert np.trace(far.covariance) > np.trace(near.covariance)
    alone = correct_jointly([seen[0], seen[2]], [prior(POSES[1])])[0]
    assert alone.status is PoseStatus.NO_MATCH


def test_agents_that_share_objects_with_each_other_alone_have_no_estimate() -> None:
    """The ego sees nothing of what both others see."""
    seen = [layout(slice(0)), seen_from(POSES[0], layout()), seen_from(POSES[1], layout())]
    assert [found.status for found in correct_jointly(seen, [prior(p) for p in POSES])] == [PoseStatus.NO_MATCH] * 2


def test_one_pair_of_agents_gives_what_the_corrector_of_pairs_gives() -> None:
    g = np.random.default_rng(0)
    ego, other = layout(), seen_from(POSES[0], layout())
    other.xy[:] += 0.1 * g.standard_normal(other.xy.shape)
    joint, pair = correct_jointly([ego, other], [prior(POSES[0])])[0], coalign.correct(ego, other, prior(POSES[0]))
    np.testing.assert_allclose(joint.pose, pair.pose, atol=1e-6)
    np.testing.assert_allclose(joint.covariance, pair.covariance, rtol=0.05, atol=4e-4)


def test_an_agent_without_prior_and_too_few_objects_have_no_estimate() -> None:
    seen = [layout(), seen_from(POSES[0], layout()), seen_from(POSES[1], layout())]
    found = correct_jointly(seen, [None, prior(POSES[1])])
    assert [e.status for e in found] == [PoseStatus.NO_MATCH, PoseStatus.CORRECTED] and found[0].pose is None
    few = correct_jointly([layout(slice(3)), seen_from(POSES[0], layout(slice(3)))], [prior(POSES[0])])
    assert few[0].status is PoseStatus.NO_MATCH
    assert correct_jointly([layout()], []) == []


@pytest.mark.parametrize(("name", "is_joint"), [("coalign", True), ("voting", False)])
def test_the_graph_belongs_to_its_corrector(name: str, is_joint: bool) -> None:
    assert (find_joint_corrector(name) is correct_jointly) == is_joint
