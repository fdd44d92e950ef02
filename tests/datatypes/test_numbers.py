# SPDX-License-Identifier: Apache-2.0
"""Points and poses as users hold them: numpy arrays, float32, lists, and what is refused with a clear text."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from manyeyes import AgentFrame, PointCloud, Transform
from manyeyes.datatypes import ShapeError

POSE = [[0.0, -1.0, 0.0, 12.0], [1.0, 0.0, 0.0, -3.5], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
POINTS = [[1.0, 2.0, 0.5], [-4.0, 0.0, 1.0]]


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16, ">f4", np.int16])
def test_points_are_taken_from_numpy_arrays_of_any_number_type(dtype) -> None:
    cloud = PointCloud.of(np.array(POINTS).astype(dtype), np.array([0, 1]), np.array([0.0, -0.5], np.float32))
    assert cloud.xyz.dtype == cloud.intensity.dtype == cloud.time_s.dtype == torch.float32
    assert cloud.xyz.tolist() == np.array(POINTS).astype(dtype).astype(float).tolist()
    assert cloud.intensity.tolist() == [0, 1] and cloud.time_s.tolist() == [0, -0.5]


def test_points_from_a_read_only_or_reversed_array_are_a_copy() -> None:
    array = np.array(POINTS, np.float32)
    array.setflags(write=False)
    assert PointCloud.of(array[::-1]).xyz.tolist() == POINTS[::-1]
    buffer = np.array(POINTS, np.float32)
    cloud = PointCloud.of(buffer)
    buffer[:] = 9.0
    assert cloud.xyz.tolist() == POINTS


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_pose_is_kept_in_float64(dtype) -> None:
    for matrix in (torch.tensor(POSE, dtype=dtype), torch.tensor(POSE, dtype=dtype).numpy(), POSE):
        pose = Transform.from_matrix(matrix)
        assert pose.rotation.dtype == pose.translation.dtype == torch.float64
        assert pose.matrix().tolist() == POSE


def test_two_agents_with_float32_poses_meet_in_one_frame() -> None:
    """The products of both poses ended in torch's 'expected m1 and m2 to have the same dtype'."""
    pose = torch.tensor(POSE, dtype=torch.float32)
    frame = AgentFrame.of(PointCloud.of(np.array(POINTS)), Transform(pose[:3, :3], pose[:3, 3]), agent_id=1)
    other = AgentFrame.of(PointCloud.of(np.array(POINTS)), Transform.from_xyz_yaw(12.0, 0.0), agent_id=2)
    assert torch.allclose(frame.now_from_earlier(other).apply(torch.zeros(1, 3)), torch.tensor([[3.5, 0.0, -0.25]]))


@pytest.mark.parametrize(
    ("make", "message_match"),
    [
        (lambda: PointCloud.of(np.zeros((5, 4))), "xyz (N, 3); got (5, 4)"),
        (lambda: PointCloud.of(np.zeros(3)), "xyz (N, 3); got (3,)"),
        (lambda: PointCloud.of(np.full((2, 3), np.nan)), "2 of 2 points are NaN"),
        (lambda: PointCloud.of(np.full((2, 3), 1e300)), "2 of 2 points are NaN or infinite"),
        (lambda: PointCloud.of(np.array([["a", "b", "c"]])), "PointCloud.xyz needs real numbers"),
        (lambda: PointCloud.of([[1.0, 2.0, 3.0], [1.0]]), "PointCloud.xyz needs a rectangular array"),
        (lambda: PointCloud.of(np.zeros((5, 3)), np.zeros(4)), "intensity (N,)"),
        (lambda: Transform.from_matrix(np.eye(3)), "(..., 4, 4)"),
        (lambda: Transform.from_matrix(2 * np.eye(4)), "not a rotation"),
        (lambda: Transform.from_matrix(np.full((4, 4), np.nan)), "finite"),
        (lambda: Transform.from_matrix(np.eye(4) * 1j), "real numbers"),
    ],
)
def test_what_cannot_be_points_or_a_pose_is_refused_by_name(make, message_match) -> None:
    with pytest.raises(ShapeError) as error:
        make()
    assert message_match in str(error.value)
