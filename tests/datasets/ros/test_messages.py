# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 by hand: organised clouds with padded rows, big-endian numbers, contradictions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from manyeyes.datasets.ros.messages import cloud_of, poses_of, read_stamp


@dataclass
class Cloud:
    """What rosbags gives for a sensor_msgs/PointCloud2."""

    data: np.ndarray
    width: int = 2
    height: int = 2
    point_step: int = 16
    row_step: int = 40
    is_bigendian: bool = False
    fields: list[Any] = field(
        default_factory=lambda: [
            SimpleNamespace(name=n, offset=4 * k, datatype=7, count=1)
            for k, n in enumerate(("x", "y", "z", "intensity"))
        ]
    )
    header: Any = field(
        default_factory=lambda: SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=7), frame_id="/lidar")
    )


def padded(order: str = "<") -> np.ndarray:
    """Two rows of two points, each row followed by 8 bytes that are no points."""
    rows = [[1, 2, 3, 0.5, 4, 5, 6, 0.25], [7, 8, 9, 1, np.nan, 0, 0, 1]]
    return np.concatenate(
        [np.r_[np.array(row, f"{order}f4").view(np.uint8), np.full(8, 255, np.uint8)] for row in rows]
    )


@pytest.mark.parametrize(("order", "big"), [("<", False), (">", True)])
def test_rows_are_padded_and_points_that_are_nan_are_no_returns(order: str, big: bool) -> None:
    cloud = cloud_of(Cloud(padded(order), is_bigendian=big))
    assert cloud.xyz.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]] and cloud.intensity.tolist() == [0.5, 0.25, 1]
    assert cloud.time_s is None


@pytest.mark.parametrize(
    "change",
    [
        {"width": 1 << 31, "height": 1 << 31},
        {"width": 3},
        {"height": 3},
        {"point_step": 0},
        {"point_step": 12},
        {"row_step": 8},
        {"data": np.zeros(10, np.uint8)},
        {"fields": Cloud(padded()).fields[1:]},
        {"fields": [SimpleNamespace(name=n, offset=1 << 40, datatype=7, count=1) for n in "xyz"]},
        {"fields": [SimpleNamespace(name=n, offset=0, datatype=99, count=1) for n in "xyz"]},
    ],
)
def test_a_cloud_that_contradicts_itself_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        cloud_of(replace(Cloud(padded()), **change))


def test_stamps_are_read_from_the_first_bytes() -> None:
    assert read_stamp(bytes([0, 1, 0, 0]) + np.array([5, 7], "<u4").tobytes(), True) == 5_000_000_007
    assert read_stamp(bytes([0, 0, 0, 0]) + np.array([5, 7], ">u4").tobytes(), True) == 5_000_000_007
    assert read_stamp(np.array([99, 5, 7], "<u4").tobytes() + b"more", False) == 5_000_000_007
    with pytest.raises(ValueError):
        read_stamp(b"short", True)


def test_a_pose_without_a_rotation_is_refused() -> None:
    point, turn = SimpleNamespace(x=1.0, y=2.0, z=3.0), SimpleNamespace(w=0.0, x=0.0, y=0.0, z=0.0)
    message = SimpleNamespace(header=Cloud(padded()).header, pose=SimpleNamespace(position=point, orientation=turn))
    with pytest.raises(ValueError, match="unit quaternion"):
        list(poses_of(message))
    turn.w = 1.0
    (pose,) = poses_of(message)
    assert (pose.timestamp_ns, pose.place, pose.parent) == (5_000_000_007, (1.0, 2.0, 3.0), "lidar")
