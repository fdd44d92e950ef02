# SPDX-License-Identifier: Apache-2.0
"""TUMTraf-V2X, read: one vehicle (agent 0, the ego) and one roadside LiDAR (agent -1) at a crossing.

Layout: ``<split>/labels_point_clouds/<...>_registered/<s>_<ns>_<...>.json`` in OpenLABEL, one frame a file, and
``<split>/point_clouds/<sensor>/<s>_<ns>_<sensor>.pcd`` of both LiDARs; the names of the first two folders may begin with an
underscore. Axes are right-handed. A label names the clouds of its frame, and has the motion that registers the vehicle's cloud with
the roadside one, in whose frame objects stand: ``cuboid.val`` is x, y, z, the quaternion x, y, z, w, then length, width, height.

The world is the frame of the crossing (``s110_base``) where the label states its place, else that of the roadside LiDAR, which is
tilted by some degrees. An agent has seen an object that holds a point of its cloud. A gap of more than a second begins a scenario.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.datasets.base import RecordingReader, require_index
from manyeyes.datasets.formats.json_file import REMEDY, get_array, get_field, get_text, load_json
from manyeyes.datasets.formats.pcd import PcdCloud, read_pcd
from manyeyes.datasets.ground_height import estimate_sensor_height
from manyeyes.datasets.lidar_frame import make_lidar_frame, rotation_of_quaternion
from manyeyes.datasets.missing import FileProblem
from manyeyes.datasets.object_types import find_label
from manyeyes.datasets.registry import register_dataset
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, RecordingError, Snapshot, Transform

VEHICLE_ID, ROADSIDE_ID = 0, -1
_LABELS, _CLOUDS = (
    "*labels_point_clouds/*_registered",
    ("point_clouds", "_point_clouds", "_points_clouds", "points_clouds"),
)
_STAMP = re.compile(r"(\d+)_(\d+)_(.+)")
_MAX_GAP_NS = 1_000_000_000
_POLE_RANGE_M, _VEHICLE_RANGE_M = 40.0, 15.0
_NOT_A_ROTATION = 0.02


def _label_folder(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob(_LABELS))), None)


def contains_labels(path: Path) -> bool:
    """Return whether a folder is a split of TUMTraf-V2X or holds some, by names alone."""
    return any(any(path.glob(f"{below}{_LABELS}/*.json")) for below in ("", "*/"))


def _time_of(path: Path) -> int | None:
    """Return nanoseconds since 1970 by the name of a file ``<s>_<ns>_<sensor>``; None of another name."""
    match = _STAMP.fullmatch(path.stem)
    return int(match[1]) * 10**9 + int(match[2]) if match and len(match[1]) < 12 and len(match[2]) < 10 else None


@dataclass(frozen=True)
class _Label:
    """What a label file states of its frame; world_from_roadside: of its LiDAR, as roadside_from_vehicle. names: of the clouds."""

    path: Path
    world_from_roadside: Transform
    roadside_from_vehicle: Transform
    names: tuple[str, ...]
    boxes: Boxes


@register_dataset(
    "tumtraf-v2x",
    matches=contains_labels,
    layout="<split>/labels_point_clouds/<...>_registered/<s>_<ns>_<...>.json and point_clouds",
)
class TumTrafRecording(RecordingReader):
    """A split of TUMTraf-V2X; scenarios are drives, named by the time of their first frame.

    Files are found by the names that labels state, when a snapshot is read. Without the vehicle's cloud the roadside one is read
    alone, and the other way round; ``verify`` names what is absent.
    """

    def __init__(self, root: Path | str, split: str | None = None, *, drop_nan: bool = True) -> None:
        self.root, self._drop_nan = Path(root), drop_nan
        folder = self.root if split is None else self.root / split
        if not folder.is_dir():
            raise RecordingError(
                f"{folder}: no such folder, expected a split of TUMTraf-V2X; check the path and the split."
            )
        labels = _label_folder(folder)
        if labels is None:
            splits = ", ".join(sorted(p.name for p in folder.iterdir() if p.is_dir() and _label_folder(p)))
            raise RecordingError(
                f"{folder}: no labels of TUMTraf-V2X in it; it has splits: {splits or 'none'}; name one."
            )
        self._clouds = next((folder / name for name in _CLOUDS if (folder / name).is_dir()), folder / _CLOUDS[0])
        stamped = sorted((t, p) for p in labels.glob("*.json") if (t := _time_of(p)) is not None)
        if not stamped:
            raise RecordingError(f"{labels}: no label <s>_<ns>_<name>.json in it; download the labels again.")
        self._labels: dict[str, list[Path]] = {}
        last, name = -_MAX_GAP_NS, ""
        for time, path in stamped:
            name = name if time - last <= _MAX_GAP_NS and name else str(time // 10**9)
            self._labels.setdefault(name, []).append(path)
            last = time
        self.scenarios = tuple(self._labels)
        self._heights: dict[tuple[str, int], float] = {}

    def length(self, scenario: str) -> int:
        """Return how many frames the drive has."""
        return len(self._of(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        """Return the vehicle and the roadside LiDAR, always 0 and -1."""
        self._of(scenario)
        return (VEHICLE_ID, ROADSIDE_ID)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        """Return the agents whose clouds are there; the truth is what is labelled."""
        require_index(self, scenario, index)
        label = _read_label(self._labels[scenario][index])
        poses = {
            VEHICLE_ID: label.world_from_roadside @ label.roadside_from_vehicle,
            ROADSIDE_ID: label.world_from_roadside,
        }
        frames = []
        for agent, path in self._cloud_paths(label).items():
            if path.is_file():
                frames.append(self._frame(scenario, agent, path, poses[agent]))
        if not frames:
            raise RecordingError(f"{label.path}: none of its clouds is in {self._clouds}; download them.")
        world_from_agent = Transform.stack([frame.world_from_agent for frame in frames])
        seen = [_hold_points(label.boxes, frame) for frame in frames]
        boxes = _mark_own_body(label.boxes, poses[VEHICLE_ID])
        return Snapshot(scenario, index, tuple(frames), GroundTruth(boxes, torch.stack(seen), world_from_agent))

    def verify_contents(self, scenario: str) -> list[FileProblem]:
        """Find the clouds that the labels of a drive name and that are not there."""
        found = []
        for path in self._of(scenario):
            paths = self._cloud_paths(_read_label(path)).values()
            found += [FileProblem(p, "missing", scenario, f"{path.name} names it") for p in paths if not p.is_file()]
        return found

    def _of(self, scenario: str) -> list[Path]:
        if scenario not in self._labels:
            require_index(self, scenario, 0)
        return self._labels[scenario]

    def _cloud_paths(self, label: _Label) -> dict[int, Path]:
        """Return the cloud of each agent: the file that the label names, in the folder of its sensor."""
        paths: dict[int, Path] = {}
        for name in label.names:
            match = _STAMP.fullmatch(Path(name).stem)
            if match is None or Path(name).name != name or match[3].endswith("_registered"):
                continue
            agent = VEHICLE_ID if match[3].startswith("vehicle") else ROADSIDE_ID
            paths[agent] = self._clouds / match[3] / name
        return dict(sorted(paths.items(), reverse=True))

    def _frame(self, scenario: str, agent: int, path: Path, world_from_lidar: Transform) -> AgentFrame:
        cloud, world_from_level = _level(read_pcd(path, self._drop_nan), world_from_lidar)
        key = scenario, agent
        if key not in self._heights:
            max_range_m = _VEHICLE_RANGE_M if agent == VEHICLE_ID else _POLE_RANGE_M
            self._heights[key] = estimate_sensor_height(cloud.xyz, max_range_m)
        time = _time_of(path) or 0
        return make_lidar_frame(
            cloud, world_from_level, self._heights[key], agent, time, is_infrastructure=agent == ROADSIDE_ID
        )


def _level(cloud: PcdCloud, world_from_lidar: Transform) -> tuple[PcdCloud, Transform]:
    """Return the cloud in a frame at the LiDAR whose z axis is the world's, and its pose: roadside LiDARs are tilted down."""
    yaw = float(world_from_lidar.yaw)
    x, y, z = world_from_lidar.translation.tolist()
    world_from_level = Transform.from_xyz_yaw(x, y, z, yaw)
    xyz = (world_from_level.inverse() @ world_from_lidar).apply(torch.from_numpy(cloud.xyz)).numpy()
    return PcdCloud(xyz, cloud.intensity, cloud.time_s), world_from_level


def _read_label(path: Path) -> _Label:
    openlabel = get_field(path, load_json(path), "openlabel")
    frames = get_field(path, openlabel, "frames", "openlabel")
    if not isinstance(frames, Mapping) or len(frames) != 1:
        count = len(frames) if isinstance(frames, Mapping) else type(frames).__name__
        raise RecordingError(f"{path}: expected one frame at 'openlabel.frames', found {count}; {REMEDY}.")
    ((key, frame),) = frames.items()
    where = f"openlabel.frames.{key}"
    properties = get_field(path, frame, "frame_properties", where)
    names = get_field(path, properties, "point_cloud_file_names", f"{where}.frame_properties")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordingError(
            f"{path}: expected a list of names at '{where}.frame_properties.point_cloud_file_names'; {REMEDY}."
        )
    registration = _registration(path, properties, f"{where}.frame_properties")
    world_from_roadside = _roadside_pose(path, openlabel)
    objects = frame.get("objects") or {}
    boxes = _read_boxes(path, objects, f"{where}.objects", world_from_roadside)
    return _Label(path, world_from_roadside, registration, tuple(names), boxes)


def _registration(path: Path, properties: Any, where: str) -> Transform:
    """Return roadside from vehicle, of the transform whose source is the vehicle's LiDAR."""
    transforms = get_field(path, properties, "transforms", where)
    for name, entry in transforms.items() if isinstance(transforms, Mapping) else ():
        if name.startswith("vehicle_lidar") and "_to_" in name:
            inner = get_field(path, entry, "transform_src_to_dst", f"{where}.transforms.{name}")
            return _motion(path, get_field(path, inner, "matrix4x4", name), f"{name}.matrix4x4")
    raise RecordingError(
        f"{path}: expected a transform vehicle_lidar_..._to_... at '{where}.transforms', found none; {REMEDY}."
    )


def _roadside_pose(path: Path, openlabel: Any) -> Transform:
    """Return the crossing's frame from the roadside LiDAR, where the label states it; else the identity."""
    systems = openlabel.get("coordinate_systems")
    for name, system in systems.items() if isinstance(systems, Mapping) else ():
        pose = system.get("pose_wrt_parent") if isinstance(system, Mapping) else None
        if isinstance(pose, Mapping) and "lidar" in name and not name.startswith("vehicle") and "matrix4x4" in pose:
            return _motion(path, pose["matrix4x4"], f"coordinate_systems.{name}.pose_wrt_parent.matrix4x4")
    return Transform.identity()


def _motion(path: Path, found: Any, name: str) -> Transform:
    matrix = get_array(path, found, (4, 4), name)
    left, scale, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(scale - 1).max() > _NOT_A_ROTATION or np.linalg.det(matrix[:3, :3]) < 0:
        raise RecordingError(
            f"{path}: '{name}' is no rigid motion (singular values {np.round(scale, 3).tolist()}); {REMEDY}."
        )
    return Transform(torch.from_numpy(left @ right), torch.from_numpy(matrix[:3, 3].copy()))


def _read_boxes(path: Path, objects: Any, where: str, world_from_roadside: Transform) -> Boxes:
    """Return the objects of known types, in the world; ids follow from their keys, which are the same in all frames."""
    if not isinstance(objects, Mapping):
        raise RecordingError(f"{path}: expected a mapping at '{where}', found {type(objects).__name__}; {REMEDY}.")
    rows, labels, ids = [], [], []
    for key, entry in objects.items():
        data = get_field(path, entry, "object_data", f"{where}.{key}")
        label = find_label(get_text(path, data, "type", f"{where}.{key}.object_data"))
        cuboid = data.get("cuboid")
        cuboid = cuboid[0] if isinstance(cuboid, list) and cuboid else cuboid
        if label is None or not cuboid:
            continue
        place = f"{where}.{key}.object_data.cuboid"
        rows.append(get_array(path, get_field(path, cuboid, "val", place), (10,), f"{place}.val"))
        labels.append(label)
        ids.append(int.from_bytes(hashlib.blake2b(key.encode(), digest_size=6).digest(), "big") + 2)
        if not 0.9 < float(np.linalg.norm(rows[-1][3:7])) < 1.1 or rows[-1][7:].min() <= 0:
            raise RecordingError(f"{path}: '{place}.val' has no unit quaternion or no size; {REMEDY}.")
    table = torch.from_numpy(np.array(rows).reshape(-1, 10))
    turn = world_from_roadside.rotation @ rotation_of_quaternion(table[:, [6, 3, 4, 5]])
    return Boxes.of(
        world_from_roadside.apply(table[:, :3]),
        table[:, 7:],
        torch.atan2(turn[:, 1, 0], turn[:, 0, 0]),
        label=torch.tensor(labels, dtype=torch.int64),
        id=torch.tensor(ids, dtype=torch.int64),
    )


def _hold_points(boxes: Boxes, frame: AgentFrame) -> torch.Tensor:
    """Return (N,) bool: which boxes hold a point of a frame."""
    local = boxes.transform(frame.world_from_agent.inverse())
    points = frame.points.xyz.double()
    radius = local.size.norm(dim=-1) / 2
    met = [
        bool(local[row : row + 1].contains(points[((points - local.center[row]).abs() <= radius[row]).all(1)]).any())
        for row in range(len(local))
    ]
    return torch.tensor(met, dtype=torch.bool)


def _mark_own_body(boxes: Boxes, world_from_vehicle: Transform) -> Boxes:
    """Give the box around the vehicle's LiDAR the vehicle's id, so that it is not evaluated."""
    x, y = world_from_vehicle.translation[:2].tolist()
    flat = Boxes.of(boxes.center * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64), boxes.size, boxes.yaw)
    own = flat.contains(torch.tensor([[x, y, 0.0]], dtype=torch.float64))[:, 0] & (boxes.class_rows() >= 0)
    id = torch.where(own, torch.full_like(boxes.id, VEHICLE_ID), boxes.id)
    return Boxes.of(boxes.center, boxes.size, boxes.yaw, label=boxes.label, id=id)
