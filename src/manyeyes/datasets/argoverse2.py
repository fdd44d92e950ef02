# SPDX-License-Identifier: Apache-2.0
"""Argoverse 2 sensor logs: one vehicle, or two of its sweeps read as two agents with a true relative pose.

Layout: ``<log>/sensors/lidar/<ns>.feather``, ``annotations.feather`` and
``city_SE3_egovehicle.feather``. AV2's ego frame has its origin at the middle of the rear axle, 0.33 m above the road
(median over a Pittsburgh log's 2,706 poses and its map's ground height); the agent's frame here is that one moved down.
The world is the log's city frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.lidar_frame import rotation_of_quaternion
from manyeyes.datasets.object_types import find_label
from manyeyes.datasets.registry import register_dataset
from manyeyes.datatypes import (
    AgentBody,
    AgentFrame,
    Boxes,
    ConfigError,
    GroundTruth,
    PointCloud,
    RecordingError,
    Snapshot,
    Transform,
)
from manyeyes.datatypes.extras import import_extra

_POSES = "city_SE3_egovehicle.feather"
_AXLE_HEIGHT_M = 0.33
_LIDAR_ABOVE_AXLE_M = 1.64
# Argo AI's fleet of those years were Ford Fusion Hybrids; length, width (without mirrors) and height by the maker: 191.8, 72.9 and
# 58 inches. The middle of the body lies ahead of the rear axle by half the length less the rear overhang of 1.1 m, unverified.
_BODY = AgentBody.standing(1.34, 0.0, (4.87, 1.85, 1.48))
_REMEDY = "copy or download the file again"
# Box ids start here, so that none is the id of an agent (0 and 1).
_FIRST_BOX_ID = 100
_RIDDEN, _RIDERS = ("BICYCLE", "MOTORCYCLE"), ("BICYCLIST", "MOTORCYCLIST", "WHEELED_RIDER")
_RIDER_DISTANCE_M = 0.8


@dataclass(frozen=True)
class Annotations:
    """All labelled objects of one sweep, of every category.

    boxes: (N), float64, in AV2's ego frame; the label counts where has_label (N,) is true. category: AV2's names.
    interior_points: (N,) int64, AV2's own count of the sweep's points inside each box.
    """

    boxes: Boxes
    category: tuple[str, ...]
    has_label: Tensor
    interior_points: Tensor

    @property
    def is_vehicle(self) -> Tensor:
        """(N,) bool: which objects are vehicles of four wheels and more."""
        return self.has_label & (self.boxes.class_rows() >= 0)


def contains_logs(path: Path) -> bool:
    """Return whether a folder is a log, holds some, or holds splits with some, by the file of poses."""
    return any(next(path.glob(f"{below}{_POSES}"), None) is not None for below in ("", "*/", "*/*/"))


@register_dataset("argoverse2", matches=contains_logs, layout=f"logs <log>/sensors/lidar/<ns>.feather with {_POSES}")
class Argoverse2Recording(RecordingReader):
    """Logs under a root or its split (or one log): snapshot i shows sweep i as agent 0, the ego.

    A log has one vehicle. With a gap above 0, sweep i + gap is agent 1: a pair of real clouds for Python; in a replay the later
    sweep comes too late for the ego. True boxes are the vehicles, pedestrians and riders at the ego's time, and those that only the
    later sweep has; an agent has seen those that hold a point of its sweep. A bicycle or motorcycle with a rider, which Argoverse 2
    labels by a second box, is left out. Logs without enough sweeps are named in ``missing_summary``.
    """

    def __init__(self, root: Path | str, split: str | None = None, *, gap: int = 0) -> None:
        if gap < 0:
            raise ConfigError(f"Argoverse2Recording needs a gap of at least 0 sweeps; got {gap}.")
        self.root = Path(root)
        self._gap = gap
        folder = self.root if split is None else self.root / split
        if not folder.is_dir():
            raise RecordingError(f"{folder}: no such folder, expected Argoverse 2 logs; check the path and the split.")
        import_extra("pyarrow", "av2", "Reading Argoverse 2")
        self._folders: dict[str, Path] = {}
        self._sweeps: dict[str, tuple[int, ...]] = {}
        problems = []
        for log in [folder] if (folder / _POSES).is_file() else _list_folders(folder):
            sweeps = tuple(sorted(int(p.stem) for p in log.glob("sensors/lidar/*.feather") if p.stem.isdecimal()))
            if len(sweeps) > gap:
                self._folders[log.name], self._sweeps[log.name] = log, sweeps
            else:
                problems.append(f"{log}: {len(sweeps)} sweeps in sensors/lidar, expected more than {gap}; left out")
        self.scenarios = tuple(self._folders)
        self.missing_summary = tuple(problems)
        if not self._folders:
            splits = [p.name for p in _list_folders(folder) if contains_logs(p) and not (p / _POSES).is_file()]
            first = f"it has splits: {', '.join(splits)}" if splits else problems[0] if problems else "it is empty"
            raise RecordingError(
                f"{folder}: no usable Argoverse 2 log ({first}); check the path, the split or the download."
            )
        self._tables: dict[tuple[Path, tuple[str, ...]], tuple[np.ndarray, ...]] = {}

    def length(self, scenario: str) -> int:
        """Return how many sweeps the log has, less the gap."""
        return len(self.sweeps(scenario)) - self._gap

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Agent 0, and 1 with a gap."""
        self.sweeps(scenario)
        return (0, 1) if self._gap else (0,)

    def sweeps(self, scenario: str) -> tuple[int, ...]:
        """Time stamps of the log's sweeps, nanoseconds, ascending."""
        if scenario not in self._sweeps:
            require_index(self, scenario, 0)
        return self._sweeps[scenario]

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return one sweep, or two as two agents; without truth where the log has no annotations."""
        require_index(self, scenario, index)
        sweeps = self._sweeps[scenario]
        times = tuple(sweeps[index + agent * self._gap] for agent in self.agents(scenario))
        frames = tuple(self._frame(scenario, agent, time) for agent, time in enumerate(times))
        labelled = (self._folders[scenario] / "annotations.feather").is_file()
        return Snapshot(scenario, index, frames, self._truth(scenario, times, frames) if labelled else None)

    def points(self, scenario: str, timestamp_ns: int) -> PointCloud:
        """Return one sweep in AV2's own ego frame."""
        path = self._folders[scenario] / "sensors" / "lidar" / f"{timestamp_ns}.feather"
        x, y, z, intensity, offset_ns = _columns(path, ("x", "y", "z", "intensity", "offset_ns"))
        xyz = np.stack((x, y, z), -1).astype(np.float32)
        bad = int((~np.isfinite(xyz).all(-1)).sum())
        if bad:
            raise RecordingError(f"{path}: {bad} of {len(xyz)} points are NaN or infinite, expected none; {_REMEDY}.")
        brightness = torch.from_numpy(intensity.astype(np.float32) / np.float32(255))
        return PointCloud.of(torch.from_numpy(xyz), brightness, torch.from_numpy(offset_ns * 1e-9))

    def annotations(self, scenario: str, timestamp_ns: int) -> Annotations:
        """Return all labelled objects of one sweep, in AV2's own ego frame."""
        path = self._folders[scenario] / "annotations.feather"
        names = ("tx_m", "ty_m", "tz_m", "length_m", "width_m", "height_m", "qw", "qx", "qy", "qz")
        time, track, category, interior = self._table(
            path, ("timestamp_ns", "track_uuid", "category", "num_interior_pts")
        )
        here = time == timestamp_ns
        values = torch.from_numpy(np.stack([c[here] for c in self._table(path, names)], -1).astype(np.float64))
        rotation = rotation_of_quaternion(values[:, 6:])
        found = tuple(str(c) for c in category[here])
        labels = [find_label(c) for c in found]
        return Annotations(
            boxes=Boxes.of(
                values[:, :3],
                values[:, 3:6],
                torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0]),
                label=torch.tensor([label or 0 for label in labels], dtype=torch.int64),
                id=torch.from_numpy(np.searchsorted(np.unique(track), track[here]) + _FIRST_BOX_ID),
            ),
            category=found,
            has_label=torch.tensor([label is not None for label in labels], dtype=torch.bool)
            & ~_has_rider(found, values[:, :2]),
            interior_points=torch.from_numpy(interior[here].astype(np.int64)),
        )

    def _frame(self, scenario: str, agent: int, timestamp_ns: int) -> AgentFrame:
        cloud = self.points(scenario, timestamp_ns)
        ego_from_agent = Transform.from_xyz_yaw(0, 0, -_AXLE_HEIGHT_M)
        return AgentFrame(
            agent_id=agent,
            timestamp_ns=timestamp_ns,
            points=cloud.transform(ego_from_agent.inverse()),
            world_from_agent=self._city_from_ego(scenario, timestamp_ns) @ ego_from_agent,
            pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
            sensor_height_m=_AXLE_HEIGHT_M + _LIDAR_ABOVE_AXLE_M,
            speed_mps=self._speed(scenario, timestamp_ns),
            body=_BODY,
        )

    def _poses(self, scenario: str) -> tuple[np.ndarray, ...]:
        names = ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
        return self._table(self._folders[scenario] / _POSES, names)

    def _city_from_ego(self, scenario: str, timestamp_ns: int) -> Transform:
        time, *parts = self._poses(scenario)
        row = np.flatnonzero(time == timestamp_ns)
        if not len(row):
            path = self._folders[scenario] / _POSES
            raise RecordingError(f"{path}: no pose at the sweep's time {timestamp_ns}; {_REMEDY}.")
        values = torch.tensor([float(p[row[0]]) for p in parts], dtype=torch.float64)
        return Transform(rotation_of_quaternion(values[:4]), values[4:])

    def _speed(self, scenario: str, timestamp_ns: int) -> float:
        """Return metres per second between the poses 50 ms before and after, or as near as the log goes."""
        time, *parts = self._poses(scenario)
        order = np.argsort(time)
        span = np.clip((timestamp_ns - 50_000_000, timestamp_ns + 50_000_000), time.min(), time.max())
        place = [np.interp(span - time.min(), time[order] - time.min(), p[order]) for p in parts[4:]]
        elapsed = float(span[1] - span[0]) * 1e-9
        return float(np.linalg.norm(np.diff(place))) / elapsed if elapsed > 0 else 0.0

    def _truth(self, scenario: str, times: tuple[int, ...], frames: tuple[AgentFrame, ...]) -> GroundTruth:
        """Return objects in the city frame: the ego's copy of a track where it has one, in the order of ids."""
        boxes, met = [], []
        for time in times:
            labelled = self.annotations(scenario, time)
            boxes.append(labelled.boxes[labelled.has_label].transform(self._city_from_ego(scenario, time)))
            met.append(labelled.boxes.id[labelled.has_label & (labelled.interior_points > 0)])
        both = Boxes.cat(boxes)
        _, first = np.unique(both.id.numpy(), return_index=True)
        union = both[torch.from_numpy(first)]
        seen = torch.stack([torch.isin(union.id, ids) for ids in met])
        return GroundTruth(union, seen, Transform.stack([f.world_from_agent for f in frames]))

    def _table(self, path: Path, names: tuple[str, ...]) -> tuple[np.ndarray, ...]:
        """Return columns that belong to the whole log; kept in memory."""
        if (path, names) not in self._tables:
            self._tables[path, names] = _columns(path, names)
        return self._tables[path, names]


def _has_rider(category: Sequence[str], xy: Tensor) -> Tensor:
    """Return (N,) bool: bicycles and motorcycles with a rider's box around the same place (N, 2)."""
    rider, ridden = (torch.tensor([c in names for c in category], dtype=torch.bool) for names in (_RIDERS, _RIDDEN))
    near = (xy[:, None] - xy[rider]).norm(dim=-1) < _RIDER_DISTANCE_M
    return ridden & near.any(1)


def _list_folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _columns(path: Path, names: tuple[str, ...]) -> tuple[np.ndarray, ...]:
    """Read named columns of a feather file as arrays."""
    from pyarrow import ArrowException, feather

    if not path.is_file():
        raise RecordingError(f"{path}: no such file, expected a feather table; download it.")
    try:
        table = feather.read_table(path, memory_map=False)
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path}: expected a feather table, found something else ({reason}); {_REMEDY}.") from None
    missing = [n for n in names if n not in table.column_names]
    if missing:
        found = ", ".join(table.column_names)
        raise RecordingError(f"{path}: expected the columns {', '.join(missing)}, found {found}; {_REMEDY}.")
    return tuple(table[n].to_numpy() for n in names)
