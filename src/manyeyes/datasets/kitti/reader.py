# SPDX-License-Identifier: Apache-2.0
"""KITTI, read: one vehicle (agent 0) with a 64-beam LiDAR 1.73 m above the road.

Points are right-handed in the LiDAR's frame, and intensity is in [0, 1]. Labels of object detection cover the view of the front
camera alone: what is beside and behind is unlabelled.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.formats.point_file import read_bin
from manyeyes.datasets.kitti.drives import (
    OBJECT_PARTS,
    KittiDrive,
    ObjectFrame,
    OdometrySequence,
    RawDrive,
    list_clouds,
)
from manyeyes.datasets.kitti.result_files import KittiCalibration
from manyeyes.datasets.lidar_frame import make_lidar_frame, merge_listed_boxes
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.registry import register_dataset
from manyeyes.datatypes import RecordingError, Snapshot

_HEIGHT_M = 1.73
_RAW = "velodyne_points"


def _object_folders(root: Path) -> list[Path]:
    """Return the folders of object detection at a root: itself, or its parts."""
    places = (root, *(root / part for part in OBJECT_PARTS))
    return [p for p in places if any((p / "velodyne").glob("*.bin")) and (p / "calib").is_dir()]


def _sequences(root: Path) -> list[Path]:
    """Return the sequences of odometry at a root: itself, one folder below, or in ``sequences``."""
    places = (root, *sorted(root.glob("sequences/*")), *(sorted(root.glob("*")) if root.name == "sequences" else ()))
    return [p for p in places if (p / "velodyne").is_dir() and (p / "times.txt").is_file()]


def _raw_drives(root: Path) -> list[Path]:
    places = (root, *sorted(root.glob("*")), *sorted(root.glob("*/*")))
    return [p for p in places if (p / _RAW / "data").is_dir()]


def contains_kitti(path: Path) -> bool:
    """Return whether a folder is in one of KITTI's three layouts, by names alone."""
    return bool(_object_folders(path) or _sequences(path) or _raw_drives(path))


@register_dataset(
    "kitti",
    matches=contains_kitti,
    layout="training/velodyne/<id>.bin with calib, sequences/<number>/velodyne with times.txt, or <drive>/velodyne_points/data",
)
class KittiRecording(RecordingReader):
    """Drives of KITTI under a root: frames of object detection (each a scenario), sequences of odometry, or raw drives.

    split: the folder ``training`` or ``testing`` of object detection; None where there is but one. Without labels snapshots have no
    truth. Drives that lack files are named in ``missing_summary``.
    """

    def __init__(self, root: Path | str, split: str | None = None, *, drop_nan: bool = False) -> None:
        self.root, self._drop_nan = Path(root), drop_nan
        folder = self.root if split is None else self.root / split
        if not folder.is_dir():
            raise RecordingError(f"{folder}: no such folder, expected a part of KITTI; check the path and the split.")
        problems: list[str] = []
        missing: list[FileProblem] = []
        self._drives = _find_drives(folder, problems, missing)
        self.scenarios = tuple(self._drives)
        self.missing_summary, self.missing_files = tuple(problems), tuple(missing)
        if not self._drives:
            first = problems[0] if problems else "no cloud <number>.bin in it"
            raise RecordingError(f"{folder}: no usable drive of KITTI; {first}. Download what is missing.")

    def length(self, scenario: str) -> int:
        """Return how many sweeps the drive has."""
        return len(self._drive(scenario).clouds)

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the one vehicle, always 0."""
        self._drive(scenario)
        return (0,)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Read one sweep; its truth is what is labelled there."""
        require_index(self, scenario, index)
        drive = self._drives[scenario]
        world_from_lidar, listed = drive.world_from_lidar(index), drive.boxes(index)
        cloud = read_bin(drive.clouds[index], self._drop_nan)
        frame = make_lidar_frame(
            cloud, world_from_lidar, _HEIGHT_M, 0, drive.timestamp_ns(index), self._speed(drive, index)
        )
        truth = None if listed is None else merge_listed_boxes([listed.transform(world_from_lidar)], [frame])
        return Snapshot(scenario, index, (frame,), truth)

    def calibration(self, scenario: str) -> KittiCalibration | None:
        """Return the camera of a frame of object detection, which results are exported for; None of other drives."""
        drive = self._drive(scenario)
        return drive.calibration() if isinstance(drive, ObjectFrame) else None

    def _drive(self, scenario: str) -> KittiDrive:
        if scenario not in self._drives:
            require_index(self, scenario, 0)
        return self._drives[scenario]

    @staticmethod
    def _speed(drive: KittiDrive, index: int) -> float:
        """Return the speed since the sweep before, m/s; 0 where there is none within half a second."""
        if index == 0:
            return 0.0
        seconds = (drive.timestamp_ns(index) - drive.timestamp_ns(index - 1)) * 1e-9
        moved = drive.world_from_lidar(index).translation - drive.world_from_lidar(index - 1).translation
        return float(moved.norm()) / seconds if 0 < seconds <= 0.5 else 0.0


def _find_drives(folder: Path, problems: list[str], missing: list[FileProblem]) -> Mapping[str, KittiDrive]:
    """Find the drives below a folder by names; what they lack is added to problems and to missing."""
    parts = _object_folders(folder)
    if len(parts) > 1:
        names = ", ".join(part.name for part in parts)
        raise RecordingError(f"{folder}: holds several parts of KITTI's object detection ({names}); name one as split.")
    drives: dict[str, KittiDrive] = {}
    for part in parts if not _sequences(folder) else ():
        has_labels = (part / "label_2").is_dir()
        for cloud in list_clouds(part / "velodyne"):
            files = [
                part / "calib" / f"{cloud.stem}.txt",
                *([part / "label_2" / f"{cloud.stem}.txt"] if has_labels else []),
            ]
            if _has_all(files, cloud.stem, problems, missing):
                drives[cloud.stem] = ObjectFrame(part, (cloud,))
    for sequence in _sequences(folder):
        poses = [
            p
            for p in (sequence / "poses.txt", sequence.parent.parent / "poses" / f"{sequence.name}.txt")
            if p.is_file()
        ]
        files = [sequence / "calib.txt", *(poses or [sequence.parent.parent / "poses" / f"{sequence.name}.txt"])]
        clouds = list_clouds(sequence / "velodyne")
        if clouds and _has_all(files, sequence.name, problems, missing):
            drives[sequence.name] = OdometrySequence(sequence, clouds)
    for raw in _raw_drives(folder):
        files = [raw / _RAW / "timestamps.txt", raw.parent / "calib_imu_to_velo.txt"]
        clouds = list_clouds(raw / _RAW / "data")
        files += [raw / "oxts" / "data" / f"{cloud.stem}.txt" for cloud in clouds]
        if clouds and _has_all(files, raw.name, problems, missing):
            drives[raw.name] = RawDrive(raw, clouds)
    return drives


def _has_all(files: list[Path], scenario: str, problems: list[str], missing: list[FileProblem]) -> bool:
    absent = [path for path in files if not path.is_file()]
    if absent:
        problems.append(
            f"{scenario}: {len(absent)} files are not there, the first is {absent[0]}; the drive is left out"
        )
        missing += [FileProblem(path, "missing", scenario, "a drive of KITTI has it") for path in absent]
    return not absent
