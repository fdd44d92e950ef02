# SPDX-License-Identifier: Apache-2.0
"""A bend keeps distances from its axis, moves poses and points alike, and cuts what it would fold."""

import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, Transform
from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.training.maps.bending import MIN_STRETCH, REACH_M, Bend


@pytest.mark.parametrize("curvature", [0.02, -0.02])
def test_the_axis_becomes_an_arc_and_goes_on_straight(curvature):
    bend, x = Bend(curvature), np.linspace(-REACH_M, REACH_M, 29)
    arc = bend.apply(np.stack((x, np.zeros_like(x)), 1))
    np.testing.assert_allclose(np.hypot(arc[:, 0], arc[:, 1] - 1 / curvature), 1 / abs(curvature))
    assert np.sign(arc[0, 1]) == np.sign(arc[-1, 1]) == np.sign(curvature)
    ends = bend.apply(np.array([[REACH_M, 0.0], [REACH_M + 10, 0.0]]))
    heading = math.atan2(*(ends[1] - ends[0])[::-1])
    assert math.isclose(heading, curvature * REACH_M) and math.isclose(np.linalg.norm(ends[1] - ends[0]), 10)


def test_distances_across_stay_and_the_origin_does_not_move():
    bend = Bend(0.02)
    np.testing.assert_array_equal(bend.apply(np.zeros((1, 2))), np.zeros((1, 2)))
    for x in (-90.0, -30.0, 0.0, 45.0, 80.0):
        across = bend.apply(np.array([[x, -4.0], [x, 0.0], [x, 3.5]]))
        np.testing.assert_allclose(np.linalg.norm(np.diff(across, axis=0), axis=1), [4.0, 3.5])


def test_a_frame_is_bent_as_the_ground_under_it():
    bend, pose = Bend(-0.015), Transform.from_xyz_yaw(20.0, 3.0, 0.5, 2.0)
    xyz = torch.tensor([[1.0, 2.0, 0.1], [-15.0, 4.0, 1.0], [8.0, -20.0, 0.0]])
    frame = AgentFrame.of(xyz, Transform.from_xyz_yaw(100.0, 50.0, 0.5, 1.0))
    bent = bend.bend_frame(frame, pose)
    before = pose.apply(xyz.double())
    after = bent.world_from_agent.apply(bent.points.xyz.double())
    np.testing.assert_allclose(after[:, :2], bend.apply(before[:, :2].numpy()), atol=1e-5)
    np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-6)
    # A point one metre ahead stays ahead, but for the stretch at its distance from the axis.
    ahead = bent.world_from_agent.inverse().apply(
        torch.tensor(np.hstack((bend.apply(pose.apply([[0.1, 0, 0]])[:, :2].numpy()), [[0.5]])))
    )
    assert abs(float(torch.atan2(ahead[0, 1], ahead[0, 0]))) < 0.05


def test_points_that_would_be_folded_are_left_out():
    bend = Bend(0.02)
    limit = (1 - MIN_STRETCH) / 0.02
    xyz = torch.tensor([[0.0, limit - 1, 0.0], [0.0, limit + 1, 0.0], [0.0, -80.0, 0.0]])
    bent = bend.bend_frame(AgentFrame.of(xyz, Transform.identity()), Transform.identity())
    assert len(bent.points.xyz) == 2
    line = MapElements.of([[[0.0, -40.0], [0.0, 60.0]]], DIVIDER)
    (cut,) = [bend.bend_elements(line)]
    assert len(cut) == 1 and cut.points[:, 1].max() <= limit and cut.points[:, 1].min() == -40.0


def test_long_edges_follow_the_arc_and_rings_stay_rings():
    bend = Bend(0.02)
    ring = [[10.0, -3.0], [14.0, -3.0], [14.0, 3.0], [10.0, 3.0]]
    bent = bend.bend_elements(MapElements.of([[[-50.0, 0.0], [50.0, 0.0]], ring], [DIVIDER, CROSSING]))
    assert bent.kind.tolist() == [DIVIDER, CROSSING] and len(bent.polyline(0)) >= 51
    np.testing.assert_allclose(np.hypot(bent.polyline(0)[:, 0], bent.polyline(0)[:, 1] - 50.0), 50.0)
    corners = bend.apply(np.array(ring))
    assert all(np.linalg.norm(bent.polyline(1) - corner, axis=1).min() < 0.7 for corner in corners)
    assert np.linalg.norm(bent.polyline(1)[0] - bent.polyline(1)[-1]) > 0.5
