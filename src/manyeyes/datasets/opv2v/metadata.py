# SPDX-License-Identifier: Apache-2.0
"""Metadata in OPV2V's layout: one agent's yaml of one instant, and the scenario's data_protocol.yaml."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from manyeyes._io import atomic_write_text
from manyeyes.datasets.formats.cache import ArrayCache
from manyeyes.datasets.formats.yaml_file import REMEDY as _REMEDY, load_yaml
from manyeyes.datasets.object_types import find_label
from manyeyes.datasets.opv2v.dialect import pose_of_matrix
from manyeyes.datatypes import LABELS, RecordingError
from manyeyes.datatypes.errors import shorten

KMH_PER_MPS = 3.6
AGENT_BODIES = "agent_bodies"
"""Key of the agents' own bodies in files of :class:`Opv2vWriter`: OPV2V lists them nowhere, and other readers skip the key."""
PROTOCOL = "data_protocol.yaml"
"""Name of the file in a scenario's folder that states how it was simulated."""
# Columns of a kept array: row 0 is the agent, the rows below are the objects that it lists.
_COLUMNS, _CACHE_KIND = 16, "opv2v3"
# Published matrices are rounded; a mirrored or sheared one is farther off than this.
_NOT_A_ROTATION = 0.02
_MAX_ID = 2**53
_MAX_DELTA_S, _MAX_HISTORY_FRAMES = 3600.0, 1_000_000
_VANS = ("sprinter", "t2", "ambulance")
_TRUCKS = ("firetruck", "carlacola", "truck")
_BUSES = ("fusorosa", "bus")


@dataclass(frozen=True)
class AgentRecord:
    """Content of one yaml in its own units and axes: metres, degrees and km/h, in OPV2V in CARLA's left-handed world.

    Objects are those of ``vehicles``, then those of AGENT_BODIES.

    lidar_pose, ego_pose, predicted_pose: [x, y, z, roll, yaw, pitch]; ego_pose is NaN where the file has none. id, label: (N,) of
    the listed objects, label -1 where the stated type is none of LABELS; location, center, extent, angle ([roll, yaw, pitch]):
    (N, 3); speed: (N,); link: (N,), the ``ass_id`` that links an object of several lists, -1 for none. has_matrix:
    lidar_pose stood as a 4x4 matrix. has_links: some object has an ``ass_id``, also -1. has_named_types: some type is capitalised,
    as those of real recordings are.
    """

    lidar_pose: tuple[float, ...]
    ego_pose: tuple[float, ...]
    speed_kmh: float
    is_infrastructure: bool
    id: np.ndarray
    label: np.ndarray
    location: np.ndarray
    center: np.ndarray
    extent: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    link: np.ndarray
    has_matrix: bool
    has_links: bool
    has_named_types: bool


@dataclass(frozen=True)
class DataProtocol:
    """What is used of data_protocol.yaml: seconds between two stems, and how many first frames are history only."""

    fixed_delta_s: float = 0.05
    history_frames: int = 0


def read_protocol(folder: Path) -> DataProtocol:
    """Return the scenario's protocol, with its defaults where the folder has none or it is silent."""
    path = folder / PROTOCOL
    if not path.is_file():
        return DataProtocol()
    content = load_yaml(path)
    world = content.get("world")
    if not isinstance(world, Mapping | None):
        raise RecordingError(f"{path}: expected a mapping at 'world', found {shorten(world)}; {_REMEDY}.")
    delta, history = (world or {}).get("fixed_delta_seconds", 0.05), content.get("history_frames") or 0
    try:
        protocol = DataProtocol(float(delta), int(history))
    except (TypeError, ValueError, OverflowError):
        protocol = DataProtocol(-1.0)
    if not (0 < protocol.fixed_delta_s <= _MAX_DELTA_S and 0 <= protocol.history_frames <= _MAX_HISTORY_FRAMES):
        raise RecordingError(
            f"{path}: expected world.fixed_delta_seconds above 0, at most {_MAX_DELTA_S:g}, and history_frames from 0 to "
            f"{_MAX_HISTORY_FRAMES}; got {shorten(delta)} and {shorten(history)}: correct them."
        )
    return protocol


def read_record(path: Path, cache: ArrayCache | None = None) -> AgentRecord:
    """Return one agent's yaml, from the cache where it has been read before: parsing takes tens of milliseconds."""
    kept = cache.load(path, _CACHE_KIND) if cache is not None and path.is_file() else None
    if kept is None or kept.ndim != 2 or kept.shape[1] != _COLUMNS:
        kept = _parse(path)
        if cache is not None:
            cache.store(path, _CACHE_KIND, kept)
    agent, vehicles = kept[0], kept[1:]
    return AgentRecord(
        lidar_pose=tuple(agent[:6].tolist()),
        ego_pose=tuple(agent[6:12].tolist()),
        speed_kmh=float(agent[12]),
        is_infrastructure=bool(agent[13]),
        id=vehicles[:, 0].astype(np.int64),
        label=vehicles[:, 1].astype(np.int64),
        location=vehicles[:, 2:5],
        center=vehicles[:, 5:8],
        extent=vehicles[:, 8:11],
        angle=vehicles[:, 11:14],
        speed=vehicles[:, 14],
        link=vehicles[:, 15].astype(np.int64),
        has_matrix=bool(agent[14]),
        has_links=bool(int(agent[15]) & 1),
        has_named_types=bool(int(agent[15]) & 2),
    )


def _parse(path: Path) -> np.ndarray:
    content = load_yaml(path)
    vehicles = content.get("vehicles", content)
    if vehicles is content:
        remedy = f"{_REMEDY}, or write 'vehicles: {{}}' where nothing is labelled"
        raise RecordingError(f"{path}: expected the key 'vehicles', found none; {remedy}.")
    listed = [
        (f"{name}.{key}", key, vehicle)
        for name, mapping in (("vehicles", vehicles), (AGENT_BODIES, content.get(AGENT_BODIES)))
        for key, vehicle in _entries(path, name, mapping)
    ]
    rows = np.zeros((1 + len(listed), _COLUMNS))
    rows[0, :6], rows[0, 14] = _pose(path, content, "lidar_pose")
    rows[0, 6:12] = _pose(path, content, "true_ego_pos")[0] if content.get("true_ego_pos") is not None else np.nan
    rows[0, 12] = _numbers(path, content, "ego_speed", 1)[0] if content.get("ego_speed") is not None else 0.0
    rows[0, 13] = bool(content.get("RSU", _below_zero(path.parent.name)))
    has_links = has_named_types = False
    for row, (yaml_path, key, vehicle) in zip(rows[1:], listed):
        if not isinstance(vehicle, Mapping):
            raise RecordingError(f"{path}: expected a mapping at '{yaml_path}', found {shorten(vehicle)}; {_REMEDY}.")
        try:
            row[0] = int(key)
            if abs(row[0]) > _MAX_ID:
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise RecordingError(
                f"{path}: expected a whole number as id of '{yaml_path}', at most 2**53; {_REMEDY}."
            ) from None
        for start, name in ((2, "location"), (5, "center"), (8, "extent"), (11, "angle")):
            row[start : start + 3] = _numbers(path, vehicle, name, 3, yaml_path)
        row[14] = _numbers(path, vehicle, "speed", 1, yaml_path)[0] if vehicle.get("speed") is not None else 0.0
        row[1] = _label(vehicle, 2 * row[8:11])
        row[15] = _link(path, vehicle, yaml_path)
        has_links |= vehicle.get("ass_id") is not None
        has_named_types |= str(vehicle.get("obj_type", ""))[:1].isupper()
    rows[0, 15] = has_links + 2 * has_named_types
    return rows


def _entries(path: Path, name: str, mapping: object) -> Sequence[tuple[Any, Any]]:
    """Return keys and values of a mapping of objects, which may be empty."""
    if not isinstance(mapping, Mapping | None):
        raise RecordingError(f"{path}: expected a mapping at '{name}', found {shorten(mapping)}; {_REMEDY}.")
    return tuple(mapping.items()) if mapping else ()


def _link(path: Path, vehicle: Mapping[Any, Any], yaml_path: str) -> int:
    found = vehicle.get("ass_id")
    if found is None:
        return -1
    if isinstance(found, bool) or not isinstance(found, int) or not -1 <= found <= _MAX_ID:
        raise RecordingError(
            f"{path}: expected a whole number from -1 at '{yaml_path}.ass_id', found {shorten(found)}; {_REMEDY}."
        )
    return found


def _pose(path: Path, content: Mapping[Any, Any], key: str) -> tuple[Sequence[float], bool]:
    """Return [x, y, z, roll, yaw, pitch], and whether it stood as a 4x4 matrix."""
    found = content.get(key)
    if not (isinstance(found, list) and found and isinstance(found[0], list)):
        return _numbers(path, content, key, 6), False
    values = (
        [v for row in found for v in row] if [len(row) for row in found[:5] if isinstance(row, list)] == [4] * 4 else []
    )
    try:
        matrix = np.array([float(v) for v in values if not isinstance(v, (list, Mapping))])
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if len(found) != 4 or matrix.size != 16 or not np.isfinite(matrix).all():
        raise RecordingError(
            f"{path}: expected 6 numbers or a 4x4 matrix of finite numbers at '{key}', found {shorten(found)}; {_REMEDY}."
        )
    matrix = matrix.reshape(4, 4)
    left, scale, right = np.linalg.svd(matrix[:3, :3])
    is_motion = np.abs(scale - 1).max() <= _NOT_A_ROTATION and np.linalg.det(matrix[:3, :3]) > 0
    if not is_motion or np.abs(matrix[3] - (0, 0, 0, 1)).max() > _NOT_A_ROTATION:
        raise RecordingError(
            f"{path}: the matrix at '{key}' is no rigid motion (singular values {np.round(scale, 3).tolist()}, last row "
            f"{shorten(matrix[3].tolist())}); write world_from_lidar with an orthonormal, right-handed rotation."
        )
    matrix[:3, :3] = left @ right
    return pose_of_matrix(matrix), True


def _below_zero(agent: str) -> bool:
    return agent.startswith("-")


def _numbers(path: Path, content: Mapping[Any, Any], key: str, count: int, yaml_path: str = "") -> Sequence[float]:
    name = f"{yaml_path}.{key}" if yaml_path else key
    found = content.get(key)
    if found is None:
        raise RecordingError(f"{path}: expected the key '{name}' with {count} numbers, found none; {_REMEDY}.")
    values = found if isinstance(found, (list, tuple)) else [found]
    try:
        numbers = [float(v) for v in values]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise RecordingError(f"{path}: expected {count} finite numbers at '{name}', found {shorten(found)}; {_REMEDY}.")
    return numbers


def _label(vehicle: Mapping[Any, Any], size: np.ndarray) -> int:
    """Return index into LABELS: by name where the file has one, else by size; -1 of a type that is none of them.

    OPV2V names no class. Our writer and real recordings have ``obj_type``; some releases have CARLA's blueprint as ``bp_id``. The
    sizes part CARLA's own vehicles: buses from 9 m, trucks from 6.5 m or as wide and high as its 5.2 m delivery truck, vans from 2
    m height. A high pick-up counts as a van.
    """
    stated = str(vehicle.get("obj_type", "")).lower()
    if stated:
        label = find_label(stated)
        return -1 if label is None else label
    blueprint = str(vehicle.get("bp_id", "")).lower()
    for label, words in (("bus", _BUSES), ("truck", _TRUCKS), ("van", _VANS)):
        if any(word in blueprint for word in words):
            return LABELS.index(label)
    length, width, height = size.tolist()
    if length >= 9:
        return LABELS.index("bus")
    if length >= 6.5 or (width >= 2.5 and height >= 2.4):
        return LABELS.index("truck")
    return LABELS.index("van" if height >= 2 else "car")


def write_record(
    path: Path,
    record: AgentRecord,
    predicted_pose: Sequence[float],
    cameras: Mapping[str, Any] | None = None,
    apart: Collection[int] = (),
) -> None:
    """Write one agent's yaml. The text is formed by hand, because PyYAML takes ten times as long as the rest of a frame.

    Args:
        path: of the file.
        record: its content.
        predicted_pose: the agent's estimate of its own pose on the road.
        cameras: their entries.
        apart: ids of the objects that stand under AGENT_BODIES, not under ``vehicles``.
    """
    lines = [f"RSU: {str(record.is_infrastructure).lower()}", f"ego_speed: {_number(record.speed_kmh)}"]
    for key, camera in (cameras or {}).items():
        lines.append(f"{key}:")
        for name, values in camera.items():
            lines.append(f"  {name}:")
            lines += [f"  - {_flow(value)}" for value in values]
    for key, pose in (("lidar_pose", record.lidar_pose), ("plan_trajectory", ())):
        lines += _list(key, pose, "")
    for key, pose in (("predicted_ego_pos", predicted_pose), ("true_ego_pos", record.ego_pose)):
        lines += _list(key, pose, "")
    is_apart = np.isin(record.id, np.array(sorted(apart), np.int64))
    lines += _objects("vehicles", record, np.flatnonzero(~is_apart)) or ["vehicles: {}"]
    lines += _objects(AGENT_BODIES, record, np.flatnonzero(is_apart))
    atomic_write_text(path, "\n".join(lines) + "\n", durable=False)


def _objects(key: str, record: AgentRecord, rows: np.ndarray) -> list[str]:
    """Return the lines of a mapping of objects, none without objects."""
    lines = [f"{key}:"] if len(rows) else []
    for i in rows.tolist():
        lines.append(f"  {int(record.id[i])}:")
        for name in ("angle", "center", "extent", "location"):
            lines += _list(name, getattr(record, name)[i].tolist(), "    ")
        lines.append(f"    obj_type: {LABELS[int(record.label[i])]}")
        lines.append(f"    speed: {_number(float(record.speed[i]))}")
    return lines


def _list(key: str, values: Sequence[float], indent: str) -> list[str]:
    if not values:
        return [f"{indent}{key}: []"]
    return [f"{indent}{key}:", *(f"{indent}- {_number(v)}" for v in values)]


def _flow(value: float | Sequence[float]) -> str:
    return _number(value) if isinstance(value, (int, float)) else f"[{', '.join(_number(v) for v in value)}]"


def _number(value: float) -> str:
    """Shortest text that reads back as the same number; yaml 1.1 takes ``1e-05`` for a string, not ``1.0e-05``."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def write_protocol(folder: Path, protocol: Mapping[str, Any], fixed_delta_s: float) -> None:
    """Write data_protocol.yaml: the given mapping, with the step of the stems under ``world``."""
    content = _plain(protocol)
    world = content.setdefault("world", {})
    if world.setdefault("fixed_delta_seconds", fixed_delta_s) != fixed_delta_s:
        raise RecordingError(
            f"{folder / 'data_protocol.yaml'}: world.fixed_delta_seconds is {world['fixed_delta_seconds']}, but the "
            f"frames were written with {fixed_delta_s}: give both the same value."
        )
    atomic_write_text(folder / "data_protocol.yaml", yaml.safe_dump(content, sort_keys=False, width=120), durable=False)


def _plain(value: Any) -> Any:
    """Mappings, sequences and numpy scalars as the plain types that yaml writes without tags."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
