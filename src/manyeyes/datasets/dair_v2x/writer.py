# SPDX-License-Identifier: Apache-2.0
"""Pairs of sweeps to disk in DAIR-V2X-C's layout, with its habits: compressed clouds, two intensity scales, numbers as
strings on the infrastructure's side, a ``rotation`` of cooperative labels that is not the world's, a stray point at (0, 0, 0).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes._io import atomic_write_text
from manyeyes.datasets.dair_v2x.index import SPLIT_FILE
from manyeyes.datasets.formats.pcd import PcdTable, write_table
from manyeyes.datatypes import LABELS, AgentFrame, Boxes, RecordingError, Snapshot, Transform

# Chosen: the receiver's y axis points ahead and it is mounted a little askew, so that no calibration is its own transpose.
_NOVATEL_FROM_LIDAR = Transform.from_rpy(
    torch.tensor([0.35, 1.2, 0.45], dtype=torch.float64),
    torch.tensor(0.01, dtype=torch.float64),
    torch.tensor(-0.02, dtype=torch.float64),
    torch.tensor(np.pi / 2 + 0.01, dtype=torch.float64),
)


@dataclass(frozen=True)
class DairRows:
    """What a drive adds to the three data_info.json, in order; plain JSON."""

    vehicle: list[dict[str, Any]]
    infrastructure: list[dict[str, Any]]
    pairs: list[dict[str, Any]]

    @property
    def frames(self) -> list[str]:
        """Ids of the vehicle's frames, by which splits name pairs."""
        return [Path(row["pointcloud_path"]).stem for row in self.vehicle]


class DairWriter:
    """Writes the pairs of one drive, so that :class:`~manyeyes.datasets.dair_v2x.DairRecording` reads them back.

    Exact to rounding: poses, boxes and time stamps (to the microsecond), points as float32, the infrastructure's
    intensity; the vehicle's intensity in 8 bits. Not in the format, hence not written: prior poses, boxes that neither
    side lists, the time of an infrastructure's point, the agents' ids (they come back as 0 and -1, and so does the id of
    the vehicle's own body). Beyond the format: ``track_id`` of labels, as in V2X-Seq, and ``lidar_height_m`` in both indices.
    """

    def __init__(self, root: Path | str, batch: str, intersection: str = "") -> None:

        self.root = Path(root)
        self.rows = DairRows([], [], [])
        self.files: list[Path] = []
        self._batch, self._intersection = batch, intersection

    def write(
        self,
        snapshot: Snapshot,
        id: int,
        unit: Snapshot | None = None,
        offset: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Write one pair under the frames' common id; unit: the instant of the infrastructure's sweep, where it is another.

        offset: ``system_error_offset``, which the written calibration lacks.
        """
        unit = snapshot if unit is None else unit
        row, pole = _row_of(snapshot, False), _row_of(unit, True)
        assert snapshot.truth is not None and unit.truth is not None
        stem = f"{id:06d}"
        vehicle = self.root / "vehicle-side"
        infrastructure = self.root / "infrastructure-side"
        world_from_lidar = _lidar_pose(snapshot, row)
        world_from_virtual = _lidar_pose(unit, pole)
        self._vehicle_cloud(vehicle / "velodyne" / f"{stem}.pcd", snapshot.frames[row])
        self._unit_cloud(infrastructure / "velodyne" / f"{stem}.pcd", unit.frames[pole])
        self._json(
            vehicle / "calib" / "novatel_to_world" / f"{stem}.json",
            _motion(world_from_lidar @ _NOVATEL_FROM_LIDAR.inverse()),
        )
        self._json(vehicle / "calib" / "lidar_to_novatel" / f"{stem}.json", {"transform": _motion(_NOVATEL_FROM_LIDAR)})
        shift = torch.tensor([*offset, 0.0], dtype=torch.float64)
        stated = Transform(world_from_virtual.rotation, world_from_virtual.translation - shift)
        blank = {"delta_x": "", "delta_y": ""}
        self._json(
            infrastructure / "calib" / "virtuallidar_to_world" / f"{stem}.json",
            {**_motion(stated), "relative_error": blank},
        )
        self._json(
            self.root / "cooperative" / "calib" / "lidar_i2v" / f"{stem}.json",
            _motion(world_from_lidar.inverse() @ world_from_virtual),
        )
        self._json(vehicle / "label" / "lidar" / f"{stem}.json", _side_labels(_listed(snapshot, row), world_from_lidar))
        listed = _listed(unit, pole)
        labels = [_as_strings(entry) for entry in _side_labels(listed, world_from_virtual)]
        self._json(infrastructure / "label" / "virtuallidar" / f"{stem}.json", labels)
        either = snapshot.truth.seen[row] | torch.isin(snapshot.truth.boxes.id, listed.id)
        everything = snapshot.truth.boxes[either].to(torch.float64)
        self._json(
            self.root / "cooperative" / "label_world" / f"{stem}.json", _world_labels(everything, world_from_virtual)
        )
        self._add_rows(stem, snapshot.frames[row], unit.frames[pole], offset)

    def _vehicle_cloud(self, path: Path, frame: AgentFrame) -> None:
        xyz = _lidar_points(frame)
        intensity = np.rint(np.clip(frame.points.intensity.numpy(), 0, 1) * 255).astype(np.uint8)
        time = frame.timestamp_ns * 1e-9 + frame.points.time_s.numpy().astype(np.float64)
        self._cloud(path, ("x", "y", "z", "intensity", "timestamp"), (*xyz.T, intensity, time))

    def _unit_cloud(self, path: Path, frame: AgentFrame) -> None:
        xyz = np.concatenate((np.zeros((1, 3), np.float32), _lidar_points(frame)))
        intensity = np.concatenate((np.zeros(1, np.float32), frame.points.intensity.numpy()))
        self._cloud(path, ("x", "y", "z", "intensity"), (*xyz.T, intensity))

    def _cloud(self, path: Path, names: tuple[str, ...], columns: tuple[np.ndarray, ...]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table(path, PcdTable(names, columns))
        self.files.append(path)

    def _json(self, path: Path, content: object) -> None:
        atomic_write_text(path, _format_json(content), durable=False)
        self.files.append(path)

    def _add_rows(self, stem: str, car: AgentFrame, pole: AgentFrame, offset: tuple[float, float]) -> None:
        for rows, frame, label, motions in (
            (self.rows.vehicle, car, "lidar", ("novatel_to_world", "lidar_to_novatel")),
            (self.rows.infrastructure, pole, "virtuallidar", ("virtuallidar_to_world",)),
        ):
            stamp = str(round(frame.timestamp_ns / 1000))
            rows.append(
                {
                    "image_path": f"image/{stem}.jpg",
                    "image_timestamp": stamp,
                    "pointcloud_path": f"velodyne/{stem}.pcd",
                    "pointcloud_timestamp": stamp,
                    "label_lidar_std_path": f"label/{label}/{stem}.json",
                    **{f"calib_{name}_path": f"calib/{name}/{stem}.json" for name in motions},
                    "batch_id": self._batch,
                    "intersection_loc": self._intersection,
                    "lidar_height_m": frame.sensor_height_m,
                }
            )
        self.rows.pairs.append(
            {
                "infrastructure_image_path": f"infrastructure-side/image/{stem}.jpg",
                "infrastructure_pointcloud_path": f"infrastructure-side/velodyne/{stem}.pcd",
                "vehicle_image_path": f"vehicle-side/image/{stem}.jpg",
                "vehicle_pointcloud_path": f"vehicle-side/velodyne/{stem}.pcd",
                "cooperative_label_path": f"cooperative/label_world/{stem}.json",
                "system_error_offset": {"delta_x": offset[0], "delta_y": offset[1]},
            }
        )


def list_pair_files(root: Path, stem: str) -> list[Path]:
    """Return the files that DairWriter writes of one pair."""
    vehicle, infrastructure, cooperative = (
        root / name for name in ("vehicle-side", "infrastructure-side", "cooperative")
    )
    return [
        vehicle / "velodyne" / f"{stem}.pcd",
        infrastructure / "velodyne" / f"{stem}.pcd",
        vehicle / "calib" / "novatel_to_world" / f"{stem}.json",
        vehicle / "calib" / "lidar_to_novatel" / f"{stem}.json",
        infrastructure / "calib" / "virtuallidar_to_world" / f"{stem}.json",
        cooperative / "calib" / "lidar_i2v" / f"{stem}.json",
        vehicle / "label" / "lidar" / f"{stem}.json",
        infrastructure / "label" / "virtuallidar" / f"{stem}.json",
        cooperative / "label_world" / f"{stem}.json",
    ]


def write_dair_index(root: Path, drives: Sequence[DairRows], splits: Mapping[str, Sequence[str]]) -> None:
    """Write the split file and the three data_info.json of all drives."""
    for path, text in make_dair_index(root, drives, splits).items():
        atomic_write_text(path, text)


def make_dair_index(root: Path, drives: Sequence[DairRows], splits: Mapping[str, Sequence[str]]) -> dict[Path, str]:
    """Make the texts of the split file (ids of the vehicle's frames by split) and of the three data_info.json of all drives.

    They are to be written in this order: the reader recognises a root by the last one.
    """
    contents = {
        "vehicle-side/data_info.json": [row for d in drives for row in d.vehicle],
        "infrastructure-side/data_info.json": [row for d in drives for row in d.infrastructure],
        SPLIT_FILE: {"cooperative_split": {name: list(ids) for name, ids in splits.items()}},
        "cooperative/data_info.json": [row for d in drives for row in d.pairs],
    }
    return {root / name: _format_json(content) for name, content in contents.items()}


def _row_of(snapshot: Snapshot, infrastructure: bool) -> int:
    rows = [i for i, frame in enumerate(snapshot.frames) if frame.is_infrastructure == infrastructure]
    if len(rows) != 1 or snapshot.truth is None:
        kind = "infrastructure" if infrastructure else "vehicle"
        raise RecordingError(
            f"Snapshot {snapshot.index} of '{snapshot.scenario}' has {len(rows)} frames of the kind {kind} and "
            f"{'no' if snapshot.truth is None else 'a'} truth: DAIR-V2X needs one of each kind, and labels."
        )
    return rows[0]


def _lidar_pose(snapshot: Snapshot, row: int) -> Transform:
    assert snapshot.truth is not None
    lift = Transform.from_xyz_yaw(0, 0, snapshot.frames[row].sensor_height_m)
    return snapshot.truth.world_from_agent[row] @ lift


def _lidar_points(frame: AgentFrame) -> np.ndarray:
    xyz = frame.points.xyz.numpy().copy()
    xyz[:, 2] -= np.float32(frame.sensor_height_m)
    return xyz


def _format_json(content: object) -> str:
    return json.dumps(content, indent=1) + "\n"


def _motion(target_from_source: Transform) -> dict[str, Any]:
    return {
        "rotation": target_from_source.rotation.tolist(),
        "translation": [[value] for value in target_from_source.translation.tolist()],
    }


def _listed(snapshot: Snapshot, row: int) -> Boxes:
    """Return what an agent lists, in the world frame; never its own body."""
    assert snapshot.truth is not None
    boxes = snapshot.truth.boxes
    return boxes[snapshot.truth.seen[row] & (boxes.id != snapshot.frames[row].agent_id)].to(torch.float64)


def _side_labels(boxes: Boxes, world_from_lidar: Transform) -> list[dict[str, Any]]:
    local = boxes.transform(world_from_lidar.inverse())
    return [_label(local, row, float(local.yaw[row])) for row in range(len(local))]


def _world_labels(boxes: Boxes, world_from_virtual: Transform) -> list[dict[str, Any]]:
    """Make labels as in the files: everything is the world's but ``rotation``, which is the yaw in the virtual LiDAR's frame."""
    yaw = boxes.transform(world_from_virtual.inverse()).yaw.tolist()
    corners = boxes.corners().tolist()
    return [{**_label(boxes, row, yaw[row]), "world_8_points": corners[row]} for row in range(len(boxes))]


def _label(boxes: Boxes, row: int, rotation: float) -> dict[str, Any]:
    length, width, height = boxes.size[row].tolist()
    x, y, z = boxes.center[row].tolist()
    entry: dict[str, Any] = {
        "type": LABELS[int(boxes.label[row])].capitalize(),
        "truncated_state": 0,
        "occluded_state": 0,
        "alpha": 0.0,
        "2d_box": {"xmin": 0.0, "ymin": 0.0, "xmax": 0.0, "ymax": 0.0},
        "3d_dimensions": {"h": height, "w": width, "l": length},
        "3d_location": {"x": x, "y": y, "z": z},
        "rotation": rotation,
    }
    if boxes.id[row] > 0:
        entry["track_id"] = f"{int(boxes.id[row]) - 1:06d}"
    return entry


def _as_strings(value: Any) -> Any:
    """Return every number as the shortest text that reads back the same."""
    if isinstance(value, dict):
        return {key: _as_strings(inner) for key, inner in value.items()}
    return repr(value) if isinstance(value, (int, float)) else value
