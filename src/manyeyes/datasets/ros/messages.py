# SPDX-License-Identifier: Apache-2.0
"""ROS messages as arrays: clouds of ``sensor_msgs/PointCloud2``, and poses of four types."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from manyeyes.datasets.formats.pcd import PcdCloud
from manyeyes.datasets.formats.point_file import scale_intensity

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
)
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MAX_POINTS = 1 << 26
_INTENSITIES = ("intensity", "intensities", "i", "reflectivity")


@dataclass(frozen=True)
class StampedPose:
    """A pose: nanoseconds, [x, y, z], the quaternion [w, x, y, z], and the frames that it joins."""

    timestamp_ns: int
    place: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    parent: str
    child: str


def read_stamp(data: bytes | memoryview, is_ros2: bool) -> int:
    """Return the time stamp of a message that begins with a header, by its first bytes; the rest is not parsed.

    Raises:
        ValueError: the message is too short.
    """
    head = bytes(data[:12])
    if len(head) < 12:
        raise ValueError(f"a message of {len(head)} bytes, expected a header")
    if is_ros2:
        seconds, nanoseconds = struct.unpack("<iI" if head[1] & 1 else ">iI", head[4:])
    else:
        _, seconds, nanoseconds = struct.unpack("<III", head)
    return seconds * 10**9 + nanoseconds


def stamp_of(header: Any) -> int:
    """Return the time of a header, nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def poses_of(message: Any) -> Iterator[StampedPose]:
    """Yield the poses of a message of POSE_TYPES or TF_TYPES.

    Raises:
        ValueError: a number is not finite, or a quaternion has no length.
    """
    if hasattr(message, "transforms"):
        for transform in message.transforms:
            yield from poses_of(transform)
        return
    child = str(getattr(message, "child_frame_id", ""))
    if hasattr(message, "transform"):
        place, turn = message.transform.translation, message.transform.rotation
    else:
        inner = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        place, turn = inner.position, inner.orientation
    xyz, wxyz = (place.x, place.y, place.z), (turn.w, turn.x, turn.y, turn.z)
    if not np.isfinite((*xyz, *wxyz)).all() or not 0.5 < np.linalg.norm(wxyz) < 2:
        raise ValueError(f"a pose {xyz}, quaternion {wxyz}, expected finite numbers and a unit quaternion")
    yield StampedPose(stamp_of(message.header), xyz, wxyz, str(message.header.frame_id).lstrip("/"), child.lstrip("/"))


def cloud_of(message: Any, intensity_max: float | None = None) -> PcdCloud:
    """Return the points of a PointCloud2 that are finite, in its own frame, with absolute times where it has them.

    intensity_max: what intensities are divided by; None: as in ``scale_intensity``.

    Raises:
        ValueError: fields, sizes and data contradict each other.
    """
    step, count = int(message.point_step), int(message.width) * int(message.height)
    row_step = int(message.row_step) or step * int(message.width)
    data = np.asarray(message.data, np.uint8)
    if (
        not 0 <= count <= _MAX_POINTS
        or step <= 0
        or len(data) < row_step * int(message.height)
        or row_step < step * int(message.width)
    ):
        raise ValueError(f"{message.height} x {message.width} points of {step} bytes in {len(data)} bytes of data")
    rows = data[: row_step * int(message.height)].reshape(int(message.height), row_step)[:, : step * int(message.width)]
    table = np.ascontiguousarray(rows).reshape(count, step)
    order = ">" if message.is_bigendian else "<"
    fields = {str(field.name): field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"fields {', '.join(fields)} without {', '.join(missing)}")
    xyz = np.stack([_column(table, fields[name], order) for name in "xyz"], 1).astype(np.float32)
    stated = next((_column(table, fields[name], order) for name in _INTENSITIES if name in fields), None)
    whole = np.isfinite(xyz).all(1)
    bright = np.zeros(count, np.float32)
    if stated is not None and intensity_max is not None:
        bright = np.clip(np.nan_to_num(stated.astype(np.float32)) / np.float32(intensity_max), 0, 1)
    elif stated is not None:
        bright = scale_intensity(stated)
    time = _times(table, fields, order, stamp_of(message.header) * 1e-9)
    return PcdCloud(xyz[whole], bright[whole], None if time is None else time[whole])


def _column(table: np.ndarray, field: Any, order: str) -> np.ndarray:
    kind = np.dtype(f"{order}{_NUMBERS[int(field.datatype)]}") if int(field.datatype) in _NUMBERS else None
    start = int(field.offset)
    if kind is None or start < 0 or start + kind.itemsize > table.shape[1]:
        raise ValueError(f"field '{field.name}' of type {field.datatype} at byte {start} of {table.shape[1]}")
    part = np.ascontiguousarray(table[:, start : start + kind.itemsize])
    return part.view(kind)[:, 0]


def _times(table: np.ndarray, fields: dict[str, Any], order: str, stamp_s: float) -> np.ndarray | None:
    """Return seconds since 1970 of each point: of Ouster's ``t`` (ns), Velodyne's ``time`` (s), or an absolute ``timestamp``."""
    if "t" in fields:
        return stamp_s + _column(table, fields["t"], order).astype(np.float64) * 1e-9
    if "time" in fields:
        return stamp_s + _column(table, fields["time"], order).astype(np.float64)
    return _column(table, fields["timestamp"], order).astype(np.float64) if "timestamp" in fields else None
