# SPDX-License-Identifier: Apache-2.0
"""CARLA's left-handed degrees against the written-out matrix of the format's description, and against compass sense."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.datasets.opv2v.carla import carla_from_transform, mirror_points, transform_from_carla

ANGLE = st.floats(-179, 179)
POSES = st.tuples(*[st.floats(-1e4, 1e4)] * 3, ANGLE, ANGLE, st.floats(-85, 85))


def carla_matrix(pose: tuple[float, ...]) -> np.ndarray:
    """world_from_lidar (4, 4), left-handed, entry by entry as OPV2V's poses are defined."""
    x, y, z = pose[:3]
    roll, yaw, pitch = np.radians(pose[3:])
    cr, sr, cy, sy, cp, sp = np.cos(roll), np.sin(roll), np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


@given(POSES)
def test_the_right_handed_motion_is_the_left_handed_one_seen_in_the_mirror(pose: tuple[float, ...]) -> None:
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    wanted = mirror @ carla_matrix(pose) @ mirror
    found = transform_from_carla(pose)
    assert torch.det(found.rotation) == pytest.approx(1.0)
    assert np.allclose(found.matrix().numpy(), wanted, atol=1e-9)


@given(POSES)
def test_a_pose_survives_both_ways(pose: tuple[float, ...]) -> None:
    there = transform_from_carla(pose)
    back = transform_from_carla(carla_from_transform(there))
    assert np.allclose(there.matrix().numpy(), back.matrix().numpy(), atol=1e-9)
    assert carla_from_transform(there) == pytest.approx(pose, abs=1e-8)


def test_senses_by_hand() -> None:
    # In CARLA yaw 90 degrees turns clockwise seen from above: towards +y there, -y in the right-handed world.
    turned = transform_from_carla((10, 20, 1, 0, 90, 0))
    assert turned.translation.tolist() == [10, -20, 1]
    assert turned.apply(torch.tensor([[1.0, 0, 0]]).double())[0].tolist() == pytest.approx([10, -21, 1])
    # Positive pitch lifts the nose; positive roll lowers the right side, and so lifts the left.
    nose = transform_from_carla((0, 0, 0, 0, 0, 30)).apply(torch.tensor([[2.0, 0, 0]]).double())[0]
    assert nose[2] == pytest.approx(1.0)
    left = transform_from_carla((0, 0, 0, 30, 0, 0)).apply(torch.tensor([[0, 2.0, 0]]).double())[0]
    assert left[2] == pytest.approx(1.0)


def test_points_are_mirrored_into_a_copy() -> None:
    points = np.array([[1, 2, 3]], np.float32)
    assert mirror_points(points).tolist() == [[1, -2, 3]] and points.tolist() == [[1, 2, 3]]
