# SPDX-License-Identifier: Apache-2.0
"""OPV2V's metadata: one agent's yaml of one instant, and the scenario's data_protocol.yaml."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from manyeyes._io import MAX_TEXT_BYTES, atomic_write_text, read_file
from manyeyes.datasets.formats.cache import ArrayCache
from manyeyes.datatypes import LABELS, RecordingError
from manyeyes.datatypes.errors import shorten

_MAX_MERGED, _MAX_MERGED_ENTRIES = 100, 10_000


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # pyright: ignore[reportGeneralTypeIssues]
    """Safe loader with a bound on merge keys (<<), which copy what they name: nested ones grow exponentially."""

    num_merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge as yaml 1.1 does, up to the bound."""
        merged = [value for key, value in node.value if key.tag == "tag:yaml.org,2002:merge"]
        num_sources = sum(len(value.value) if isinstance(value, yaml.SequenceNode) else 1 for value in merged)
        if num_sources <= _MAX_MERGED:
            super().flatten_mapping(node)
            self.num_merged += len(node.value) if merged else 0
        if num_sources > _MAX_MERGED or self.num_merged > _MAX_MERGED_ENTRIES:
            raise yaml.YAMLError(f"'<<' merges more than {_MAX_MERGED} mappings or {_MAX_MERGED_ENTRIES:,} entries")


KMH_PER_MPS = 3.6
_REMEDY = "copy or download the file again"
# Columns of a kept array: row 0 is the agent, the rows below are the vehicles that it lists.
_COLUMNS = 16
_MAX_ID = 2**53
_MAX_DELTA_S, _MAX_HISTORY_FRAMES = 3600.0, 1_000_000
_VANS = ("sprinter", "t2", "ambulance")
_TRUCKS = ("firetruck", "carlacola", "truck")
_BUSES = ("fusorosa", "bus")


@dataclass(frozen=True)
class AgentRecord:
    """Content of one yaml in its own units: metres, degrees and km/h in CARLA's left-handed world.

    lidar_pose, ego_pose, predicted_pose: [x, y, z, roll, yaw, pitch]; ego_pose is NaN where the file has none.
    id, label: (N,) of the listed vehicles; location, center, extent, angle ([roll, yaw, pitch]): (N, 3); speed: (N,).
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


@dataclass(frozen=True)
class DataProtocol:
    """What is used of data_protocol.yaml: seconds between two stems, and how many first frames are history only."""

    fixed_delta_s: float = 0.05
    history_frames: int = 0


def load_yaml(path: Path) -> Mapping[Any, Any]:
    """Return the mapping at the top of a yaml file; anchors and aliases are resolved."""
    try:
        content = yaml.load(read_file(path, MAX_TEXT_BYTES), _Loader)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}), expected a yaml file; {_REMEDY}.") from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path}: expected yaml, found something else ({reason}); {_REMEDY}.") from None
    if not isinstance(content, Mapping):
        raise RecordingError(f"{path}: expected a yaml mapping, found {type(content).__name__}; {_REMEDY}.")
    return content


def read_protocol(folder: Path) -> DataProtocol:
    """Return the scenario's protocol, with its defaults where the folder has none or it is silent."""
    path = folder / "data_protocol.yaml"
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
    kept = cache.load(path, "opv2v1") if cache is not None and path.is_file() else None
    if kept is None or kept.ndim != 2 or kept.shape[1] != _COLUMNS:
        kept = _parse(path)
        if cache is not None:
            cache.store(path, "opv2v1", kept)
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
    )


def _parse(path: Path) -> np.ndarray:
    content = load_yaml(path)
    vehicles = content.get("vehicles", content)
    if vehicles is content:
        remedy = f"{_REMEDY}, or write 'vehicles: {{}}' where nothing is labelled"
        raise RecordingError(f"{path}: expected the key 'vehicles', found none; {remedy}.")
    if not isinstance(vehicles, Mapping | None):
        raise RecordingError(f"{path}: expected a mapping at 'vehicles', found {shorten(vehicles)}; {_REMEDY}.")
    rows = np.zeros((1 + len(vehicles or ()), _COLUMNS))
    rows[0, :6] = _numbers(path, content, "lidar_pose", 6)
    rows[0, 6:12] = _numbers(path, content, "true_ego_pos", 6) if content.get("true_ego_pos") is not None else np.nan
    rows[0, 12] = _numbers(path, content, "ego_speed", 1)[0] if content.get("ego_speed") is not None else 0.0
    rows[0, 13] = bool(content.get("RSU", _below_zero(path.parent.name)))
    for row, (key, vehicle) in zip(rows[1:], (vehicles or {}).items()):
        yaml_path = f"vehicles.{key}"
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
    return rows


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
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise RecordingError(f"{path}: expected {count} finite numbers at '{name}', found {shorten(found)}; {_REMEDY}.")
    return numbers


def _label(vehicle: Mapping[Any, Any], size: np.ndarray) -> int:
    """Return index into LABELS: by name where the file has one, else by size.

    OPV2V names no class. Our writer adds ``obj_type``; some releases have CARLA's blueprint as ``bp_id``. The sizes
    part CARLA's own vehicles: buses from 9 m, trucks from 6.5 m or as wide and high as its 5.2 m delivery truck, vans
    from 2 m height. A high pick-up counts as a van.
    """
    stated = str(vehicle.get("obj_type", "")).lower()
    if stated in LABELS:
        return LABELS.index(stated)
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
    path: Path, record: AgentRecord, predicted_pose: Sequence[float], cameras: Mapping[str, Any] | None = None
) -> None:
    """Write one agent's yaml; predicted_pose: the agent's estimate of its own pose on the road; cameras: their entries.

    The text is formed by hand, because PyYAML takes ten times as long as the rest of a frame.
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
    lines.append("vehicles:" if len(record.id) else "vehicles: {}")
    for i, key in enumerate(record.id.tolist()):
        lines.append(f"  {key}:")
        for name in ("angle", "center", "extent", "location"):
            lines += _list(name, getattr(record, name)[i].tolist(), "    ")
        lines.append(f"    obj_type: {LABELS[int(record.label[i])]}")
        lines.append(f"    speed: {_number(float(record.speed[i]))}")
    atomic_write_text(path, "\n".join(lines) + "\n", durable=False)


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
