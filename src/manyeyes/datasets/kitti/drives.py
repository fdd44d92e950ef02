# SPDX-License-Identifier: Apache-2.0
"""KITTI's three layouts as drives: frames with a cloud, a time, a pose of the LiDAR, and labels in the LiDAR's frame.

Object detection: ``training/velodyne/<id>.bin``, ``calib``, ``label_2``; frames are unrelated, so each is a drive of one frame at
the origin. Odometry: ``sequences/<number>/velodyne``, ``calib.txt``, ``times.txt``, ``poses/<number>.txt``. Raw:
``<date>/<drive>/velodyne_points``, ``oxts``, ``tracklet_labels.xml``, and ``<date>/calib_imu_to_velo.txt``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import torch

from manyeyes.datasets.kitti.result_files import KittiCalibration, read_calibration, read_camera_pose
from manyeyes.datasets.kitti.text_files import (
    REMEDY,
    parse_numbers,
    read_labels,
    read_matrix,
    read_poses,
    read_stamps,
    read_text,
    read_tracklets,
    to_motion,
)
from manyeyes.datatypes import Boxes, RecordingError, Transform

OBJECT_PARTS = ("training", "testing")
_EARTH_RADIUS_M = 6378137.0
_Item = TypeVar("_Item")


class KittiDrive(Protocol):
    """One scenario: consecutive sweeps of one LiDAR."""

    @property
    def clouds(self) -> Sequence[Path]:
        """The file of each sweep, in the order of time."""
        ...

    def timestamp_ns(self, index: int) -> int:
        """Return the time of a sweep."""
        ...

    def world_from_lidar(self, index: int) -> Transform:
        """Return the pose of the LiDAR, float64."""
        ...

    def boxes(self, index: int) -> Boxes | None:
        """Return what is labelled, in the LiDAR's frame; None without labels."""
        ...


@dataclass(frozen=True)
class ObjectFrame:
    """One frame of the object detection data; clouds: its one."""

    folder: Path
    clouds: tuple[Path, ...]

    @property
    def stem(self) -> str:
        """Number of the frame, as in file names."""
        return self.clouds[0].stem

    def timestamp_ns(self, index: int) -> int:
        """Return 0: the frames have no times."""
        return 0

    def world_from_lidar(self, index: int) -> Transform:
        """Return the identity: the frames have no poses."""
        return Transform.identity()

    def boxes(self, index: int) -> Boxes | None:
        """Return what label_2 lists; None in the testing part."""
        path, calibration = self.folder / "label_2" / f"{self.stem}.txt", self.folder / "calib" / f"{self.stem}.txt"
        if not path.is_file():
            return None
        return read_labels(path, read_camera_pose(calibration).inverse())

    def calibration(self) -> KittiCalibration:
        """Return the camera that labels and results of the frame belong to."""
        return read_calibration(self.folder / "calib" / f"{self.stem}.txt")


@dataclass(frozen=True)
class OdometrySequence:
    """One sequence of the odometry data; its world is the LiDAR's frame at the first sweep."""

    folder: Path
    clouds: tuple[Path, ...]

    @cached_property
    def _times_ns(self) -> list[int]:
        path = self.folder / "times.txt"
        lines = read_text(path).split()
        return [round(parse_numbers(path, word, 1, f"line {n}")[0] * 1e9) for n, word in enumerate(lines, 1)]

    @cached_property
    def _poses(self) -> list[Transform]:
        calibration = self.folder / "calib.txt"
        camera_from_lidar = to_motion(calibration, read_matrix(calibration, "Tr", shape=(3, 4)), "Tr")
        path = self.folder / "poses.txt"
        path = path if path.is_file() else self.folder.parent.parent / "poses" / f"{self.folder.name}.txt"
        return [camera_from_lidar.inverse() @ pose @ camera_from_lidar for pose in read_poses(path)]

    def timestamp_ns(self, index: int) -> int:
        """Return the time since the first sweep."""
        return _row(self._times_ns, self.clouds, index, self.folder / "times.txt")

    def world_from_lidar(self, index: int) -> Transform:
        """Return the pose by poses/<number>.txt, which the sequences from 11 on lack."""
        return _row(self._poses, self.clouds, index, self.folder.parent.parent / "poses" / f"{self.folder.name}.txt")

    def boxes(self, index: int) -> Boxes | None:
        """Return None: odometry has no objects."""
        return None


@dataclass(frozen=True)
class RawDrive:
    """One synchronised drive of the raw data; its world is a Mercator projection, z up, with its origin at the first sweep."""

    folder: Path
    clouds: tuple[Path, ...]

    @cached_property
    def _times_ns(self) -> dict[str, int]:
        """Times by stems: a sweep may be absent, its line is not."""
        stamps = read_stamps(self.folder / "velodyne_points" / "timestamps.txt")
        return {f"{index:010d}": stamp for index, stamp in enumerate(stamps)}

    @cached_property
    def _lidar_from_imu(self) -> Transform:
        path = self.folder.parent / "calib_imu_to_velo.txt"
        rotation, translation = read_matrix(path, "R", shape=(3, 3)), read_matrix(path, "T", shape=(3, 1))
        return to_motion(path, np.concatenate((rotation, translation), 1), "R, T")

    @cached_property
    def _first(self) -> tuple[float, Transform]:
        """The scale of the projection, and the pose of the IMU at the first sweep in the projection."""
        path = self._oxts(0)
        scale = math.cos(math.radians(float(self._values(path)[0])))
        return scale, self._projected(path, scale)

    @cached_property
    def _tracklets(self) -> list[Boxes] | None:
        path = self.folder / "tracklet_labels.xml"
        stems = [int(cloud.stem) for cloud in self.clouds]
        return read_tracklets(path, max(stems) + 1) if path.is_file() else None

    def timestamp_ns(self, index: int) -> int:
        """Return the time of the sweep, since 1970."""
        stem = self.clouds[index].stem
        if stem not in self._times_ns:
            path = self.folder / "velodyne_points" / "timestamps.txt"
            raise RecordingError(f"{path}: {len(self._times_ns)} lines, expected one of frame {stem}; {REMEDY}.")
        return self._times_ns[stem]

    def world_from_lidar(self, index: int) -> Transform:
        """Return the pose by the GPS and IMU of the same frame."""
        scale, first = self._first
        projected = self._projected(self._oxts(index), scale)
        return Transform(projected.rotation, projected.translation - first.translation) @ self._lidar_from_imu.inverse()

    def boxes(self, index: int) -> Boxes | None:
        """Return what the tracklets list; None where the drive has none."""
        return None if self._tracklets is None else self._tracklets[int(self.clouds[index].stem)]

    def _oxts(self, index: int) -> Path:
        return self.folder / "oxts" / "data" / f"{self.clouds[index].stem}.txt"

    @staticmethod
    def _values(path: Path) -> np.ndarray:
        """Return latitude, longitude, degrees, altitude, metres, roll, pitch, yaw, radians (0 to the east)."""
        return parse_numbers(path, " ".join(read_text(path).split()[:6]), 6, "its first line")

    def _projected(self, path: Path, scale: float) -> Transform:
        latitude, longitude, altitude, *angles = (float(v) for v in self._values(path))
        if abs(latitude) >= 90:
            raise RecordingError(f"{path}: expected a latitude within 90 degrees, found {latitude}; {REMEDY}.")
        x = scale * _EARTH_RADIUS_M * math.radians(longitude)
        y = scale * _EARTH_RADIUS_M * math.log(math.tan(math.radians(90 + latitude) / 2))
        roll, pitch, yaw = torch.tensor(angles, dtype=torch.float64)
        return Transform.from_rpy(torch.tensor([x, y, altitude], dtype=torch.float64), roll, pitch, yaw)


def list_clouds(folder: Path) -> tuple[Path, ...]:
    """Return the clouds of a folder whose names are numbers, in their order."""
    return tuple(sorted((p for p in folder.glob("*.bin") if p.stem.isdecimal()), key=lambda p: int(p.stem)))


def _row(rows: Sequence[_Item], clouds: Sequence[Path], index: int, path: Path) -> _Item:
    """Return the row of a frame in a file that has a line for each, by the number in its name."""
    number = int(clouds[index].stem)
    if number >= len(rows):
        raise RecordingError(f"{path}: {len(rows)} lines, expected one of frame {number}; {REMEDY}.")
    return rows[number]
