# SPDX-License-Identifier: Apache-2.0
"""Points, poses and boxes as users hold them: numpy arrays, float32, lists, and what is refused with a clear text."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from manyeyes import AgentFrame, Boxes, PointCloud, Transform
from manyeyes.datatypes import GroundTruth, ShapeError

POSE = [[0.0, -1.0, 0.0, 12.0], [1.0, 0.0, 0.0, -3.5], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
POINTS = [[1.0, 2.0, 0.5], [-4.0, 0.0, 1.0]]
SIZES = [[4.0, 2.0, 1.5], [10.0, 2.5, 3.0]]


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
    ("as_given", "dtype"),
    [
        (list, torch.float64),
        (np.array, torch.float64),
        (lambda rows: np.array(rows, np.float32), torch.float32),
        (lambda rows: np.array(rows).astype(">f4"), torch.float32),
        (lambda rows: np.array(rows, np.float16), torch.float64),
        (lambda rows: torch.tensor(rows, dtype=torch.float32), torch.float32),
        (lambda rows: torch.tensor(rows, dtype=torch.float64), torch.float64),
    ],
)
def test_boxes_are_of_the_type_of_their_centers(as_given, dtype) -> None:
    boxes = Boxes.of(
        as_given(POINTS), as_given(SIZES), as_given([0.5, -1.0]), [0.75, 0.5], np.array([1, 2]), [7, 8], np.eye(2)
    )
    for name in ("center", "size", "yaw", "score", "velocity", "sigma_xy"):
        assert getattr(boxes, name).dtype == dtype, name
    assert boxes.label.dtype == boxes.id.dtype == torch.int64
    assert (boxes.center.tolist(), boxes.size.tolist(), boxes.yaw.tolist()) == (POINTS, SIZES, [0.5, -1.0])
    assert (boxes.score.tolist(), boxes.label.tolist(), boxes.id.tolist()) == ([0.75, 0.5], [1, 2], [7, 8])
    assert boxes.velocity.tolist() == [[1, 0], [0, 1]]
    assert boxes.contains(as_given(POINTS)).tolist() == [[True, False], [False, True]]
    assert len(Boxes.of(np.zeros((0, 3)), np.zeros((0, 3)), [])) == 0


@pytest.mark.parametrize("as_given", [list, np.array, torch.tensor])
def test_points_are_moved_whatever_holds_them(as_given) -> None:
    moved = Transform.from_matrix(POSE).apply(as_given(POINTS))
    assert moved.tolist() == [[10.0, -2.5, 0.75], [12.0, -7.5, 1.25]]
    assert Transform.from_matrix(POSE).apply(np.array(POINTS, np.float32)).dtype == torch.float32


@pytest.mark.parametrize("as_given", [list, np.array, torch.tensor, lambda rows: np.array(rows, np.float32)])
def test_a_frame_and_its_truth_are_built_of_numbers(as_given) -> None:
    frame = AgentFrame.of(
        as_given(POINTS), as_given(POSE), 3, 10, as_given([[1.0, 0, 0], [0, 1, 0], [0, 0, 0.5]]), 2.5, 8.0
    )
    assert frame.points.xyz.tolist() == POINTS and frame.world_from_agent.matrix().tolist() == POSE
    assert frame.pose_covariance.dtype == torch.float64 and frame.pose_covariance.diag().tolist() == [1, 1, 0.5]
    assert (frame.agent_id, frame.timestamp_ns, frame.sensor_height_m, frame.speed_mps) == (3, 10, 2.5, 8.0)
    boxes = Boxes.of(as_given(POINTS), as_given(SIZES), as_given([0.0, 0.0]))
    truth = GroundTruth.of(boxes, as_given([POSE]))
    assert truth.seen.tolist() == [[True, True]] and truth.boxes.center.dtype == torch.float64
    assert GroundTruth.of(boxes, as_given([POSE]), [[0, 1]]).seen.tolist() == [[False, True]]


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
        (
            lambda: Transform.from_matrix(POSE).apply(np.zeros((5, 2))),
            "Transform.apply needs points (..., N, 3); got (5, 2)",
        ),
        (lambda: Boxes.of(np.zeros((2, 2)), SIZES, [0, 0]), "Boxes.center needs shape (2, 3); got (2, 2)"),
        (lambda: Boxes.of(torch.tensor(5.0), SIZES, [0, 0]), "Boxes.center needs shape (0, 3); got ()"),
        (lambda: Boxes.of(POINTS, np.zeros((3, 3)), [0, 0]), "Boxes.size needs shape (2, 3); got (3, 3)"),
        (lambda: Boxes.of(POINTS, SIZES, [[0, 0]]), "Boxes.yaw needs shape (2,); got (1, 2)"),
        (lambda: Boxes.of(POINTS, SIZES, [0, 0], label=["car", "bus"]), "Boxes.label needs real numbers"),
        (lambda: AgentFrame.of(np.zeros((5, 4)), POSE), "xyz (N, 3); got (5, 4)"),
        (lambda: AgentFrame.of(POINTS, np.eye(3)), "(..., 4, 4)"),
        (
            lambda: AgentFrame.of(POINTS, POSE, pose_covariance=np.eye(2)),
            "AgentFrame.pose_covariance needs (3, 3); got (2, 2)",
        ),
        (
            lambda: GroundTruth.of(Boxes.of(POINTS, SIZES, [0, 0]), POSE),
            "world_from_agent needs the batch shape (agents,); got ()",
        ),
        (lambda: GroundTruth.of(Boxes.of(POINTS, SIZES, [0, 0]), [POSE], [[1]]), "seen needs (1, 2); got (1, 1)"),
    ],
)
def test_invalid_points_and_poses_are_rejected_by_field(make, message_match) -> None:
    with pytest.raises(ShapeError) as error:
        make()
    assert message_match in str(error.value)
