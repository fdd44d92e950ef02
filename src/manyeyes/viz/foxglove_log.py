# SPDX-License-Identifier: Apache-2.0
"""Frames for the viewer Foxglove (https://foxglove.dev): an MCAP file of its JSON schemas.

| topic | schema | content |
|---|---|---|
| `/tf` | FrameTransform | claimed pose of each agent, from `world` to `agent_ID` |
| `/agents/ID/cloud` | PointCloud | x, y, z, intensity and colour in `agent_ID` |
| `/GROUP` | SceneUpdate | boxes and lines in `world`, by group of ``viz.spatial_entities``; scores, bytes and ages as metadata |
| `/plots` | plain JSON | numbers by path |
| `/events` | Log | lines of text |

The schemas are stated as far as the fields are written: https://docs.foxglove.dev/docs/visualization/message-schemas.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from manyeyes._io import atomic_replace
from manyeyes.datatypes import Transform
from manyeyes.datatypes.extras import import_extra
from manyeyes.viz.spatial_entities import (
    AgentGroup,
    BoxGroup,
    CloudColor,
    LineGroup,
    LoggedAgent,
    LoggedCloud,
    LoggedLines,
    NumberGroup,
    Rgb,
    SpatialDescription,
)
from manyeyes.viz.spatial_frame import Floats, SpatialFrame

_UINT8, _FLOAT32, _INFO, _LINE_STRIP = 1, 7, 2, 0
_LABEL_M = 0.8
"""Height of the letters of labels."""
_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
    + [(c, "u1") for c in ("red", "green", "blue", "alpha")]
)
_NO_CLOUD = LoggedCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8))
Json = dict[str, Any]


def _object(**properties: Json) -> Json:
    return {"type": "object", "properties": properties}


def _array(items: Json) -> Json:
    return {"type": "array", "items": items}


_NUMBER, _INTEGER, _TEXT, _BOOL = ({"type": name} for name in ("number", "integer", "string", "boolean"))
_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE, _COLOR = _object(position=_VECTOR, orientation=_QUATERNION), _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE = _object(type=_INTEGER, pose=_POSE, thickness=_NUMBER, points=_array(_VECTOR), color=_COLOR)
_ENTITY = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_TIME,
    metadata=_array(_object(key=_TEXT, value=_TEXT)),
    cubes=_array(_object(pose=_POSE, size=_VECTOR, color=_COLOR)),
    lines=_array(_LINE),
    texts=_array(
        _object(pose=_POSE, billboard=_BOOL, font_size=_NUMBER, scale_invariant=_BOOL, color=_COLOR, text=_TEXT)
    ),
)
_DELETION = _object(timestamp=_TIME, type=_INTEGER, id=_TEXT)
_FIELD = _object(name=_TEXT, offset=_INTEGER, type=_INTEGER)
_SCHEMAS: dict[str, Json] = {
    "foxglove.FrameTransform": _object(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
    ),
    "foxglove.PointCloud": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        point_stride=_INTEGER,
        fields=_array(_FIELD),
        data={"type": "string", "contentEncoding": "base64"},
    ),
    "foxglove.SceneUpdate": _object(deletions=_array(_DELETION), entities=_array(_ENTITY)),
    "foxglove.Log": _object(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT),
    "manyeyes.Plots": {"type": "object"},
}
_DELETE_ALL = 1


class FoxgloveLog:
    """Writes frames to a file (.mcap) that appears when the log is closed.

    Raises:
        MissingExtraError: mcap is not installed.
    """

    def __init__(self, path: Path, cloud_color: CloudColor = "agent") -> None:
        writer = import_extra("mcap.writer", "live", "Writing a file for Foxglove")
        self._files, self._channels = ExitStack(), dict[str, int]()
        self._description, self._clouds = SpatialDescription(cloud_color), set[str]()
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = self._files.enter_context(atomic_replace(path))
        self._writer: Any = writer.Writer(self._files.enter_context(draft.open("wb")))
        self._writer.start(profile="", library="manyeyes")
        self._schemas = {
            name: self._writer.register_schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
            for name, schema in _SCHEMAS.items()
        }

    def __enter__(self) -> FoxgloveLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._writer.finish()
        self._files.__exit__(kind, error, trace)

    def add(self, frame: SpatialFrame) -> None:
        """Write the frame of one instant."""
        now_ns = frame.capture_ns
        for entity in self._description.describe(frame):
            match entity:
                case AgentGroup():
                    self._add_agents(entity, now_ns)
                case BoxGroup():
                    self._add_scene(entity.group, now_ns, _make_cubes(entity))
                case LineGroup():
                    self._add_scene(
                        entity.group, now_ns, [_make_lines(item, entity.shows_labels) for item in entity.items]
                    )
                case NumberGroup():
                    self._write("/plots", "manyeyes.Plots", now_ns, _nest(entity.values))
                case _:
                    for text in entity.lines:
                        log = {"timestamp": _time(now_ns), "level": _INFO, "message": text, "name": "manyeyes"}
                        self._write("/events", "foxglove.Log", now_ns, log)

    def _add_agents(self, agents: AgentGroup, now_ns: int) -> None:
        for agent in agents.items:
            self._add_pose(agent, now_ns)
        clouds = {agent.name: agent.cloud for agent in agents.items if agent.cloud is not None}
        for name, cloud in {**dict.fromkeys(sorted(self._clouds - clouds.keys()), _NO_CLOUD), **clouds}.items():
            self._add_cloud(name, cloud, now_ns)
        self._clouds = set(clouds)

    def _add_pose(self, agent: LoggedAgent, now_ns: int) -> None:
        transform = {
            "timestamp": _time(now_ns),
            "parent_frame_id": "world",
            "child_frame_id": f"agent_{agent.name}",
            "translation": _vector(agent.world_from_agent.translation.tolist()),
            "rotation": _quaternion(agent.world_from_agent),
        }
        self._write("/tf", "foxglove.FrameTransform", now_ns, transform)

    def _add_cloud(self, name: str, cloud: LoggedCloud, now_ns: int) -> None:
        rows = np.zeros(len(cloud.points), _POINT)
        columns = (*cloud.points.T, cloud.intensity, *cloud.colors.T, 255)
        for field, column in zip(_POINT.names or (), columns):
            rows[field] = column
        fields = [
            {"name": field, "offset": int(offset), "type": _FLOAT32 if kind == np.float32 else _UINT8}
            for field, (kind, offset, *_) in (_POINT.fields or {}).items()
        ]
        content = {
            "timestamp": _time(now_ns),
            "frame_id": f"agent_{name}",
            "pose": _pose((0.0, 0.0, 0.0)),
            "point_stride": _POINT.itemsize,
            "fields": fields,
            "data": base64.b64encode(rows.tobytes()).decode(),
        }
        self._write(f"/agents/{name}/cloud", "foxglove.PointCloud", now_ns, content)

    def _add_scene(self, group: str, now_ns: int, entities: Sequence[Json]) -> None:
        """Replace the entities of a group."""
        stamp = _time(now_ns)
        update = {
            "deletions": [{"timestamp": stamp, "type": _DELETE_ALL, "id": ""}],
            "entities": [{"timestamp": stamp, "frame_id": "world", **entity} for entity in entities],
        }
        self._write(f"/{group}", "foxglove.SceneUpdate", now_ns, update)

    def _write(self, topic: str, schema: str, now_ns: int, content: Json) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[schema]
            )
        data = json.dumps(content, allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], now_ns, data, now_ns)


def _time(time_ns: int) -> Json:
    return {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}


def _vector(xyz: Sequence[float]) -> Json:
    return dict(zip("xyz", map(float, xyz)))


def _yaw_quaternion(yaw: float) -> Json:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _quaternion(pose: Transform) -> Json:
    """Return the unit quaternion of a rotation, from its largest component on (Shepperd 1978)."""
    r = pose.rotation.double().numpy()
    squared = np.array(
        [
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
            1 + r[0, 0] + r[1, 1] + r[2, 2],
        ]
    )
    rows = np.array(
        [
            [squared[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], squared[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squared[2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squared[3]],
        ]
    )
    found = rows[int(squared.argmax())]
    return dict(zip("xyzw", (found / np.linalg.norm(found)).tolist()))


def _pose(xyz: Sequence[float], yaw: float = 0.0) -> Json:
    return {"position": _vector(xyz), "orientation": _yaw_quaternion(yaw)}


def _color(rgb: Rgb | Sequence[int], alpha: float = 1.0) -> Json:
    return {**dict(zip("rgb", (value / 255 for value in rgb))), "a": alpha}


def _entity(name: str, metadata: Mapping[str, str] | None = None, **primitives: list[Json]) -> Json:
    """Return an entity without time and frame; it stays until it is replaced."""
    pairs = [{"key": key, "value": value} for key, value in (metadata or {}).items()]
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    every = {kind: primitives.get(kind, []) for kind in kinds}
    return {"id": name, "lifetime": _time(0), "frame_locked": False, "metadata": pairs, **every}


def _line(points: Floats, color: Rgb, thickness_m: float) -> Json:
    """Return a line through points (N, 3)."""
    return {
        "type": _LINE_STRIP,
        "pose": _pose((0.0, 0.0, 0.0)),
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [_vector(point) for point in points.tolist()],
        "color": _color(color),
        "colors": [],
        "indices": [],
    }


def _text(text: str, xyz: Sequence[float], color: Rgb | Sequence[int]) -> Json:
    """Return a text that faces the viewer, at a place in the world."""
    return {
        "pose": _pose(xyz),
        "billboard": True,
        "font_size": _LABEL_M,
        "scale_invariant": False,
        "color": _color(color),
        "text": text,
    }


def _make_cubes(cubes: BoxGroup) -> list[Json]:
    boxes = cubes.boxes
    places = zip(boxes.center.tolist(), boxes.size.tolist(), boxes.yaw.tolist())
    found = list[Json]()
    for row, (center, size, yaw) in enumerate(places):
        color, metadata = cubes.colors[row].tolist(), cubes.metadata[row]
        cube = {"pose": _pose(center, yaw), "size": _vector(size), "color": _color(color, 0.5)}
        above = (center[0], center[1], center[2] + size[2] / 2)
        texts = [_text(cubes.labels[row], above, color)] if cubes.shows_labels else []
        found.append(_entity(str(row), metadata, cubes=[cube], texts=texts))
    return found


def _make_lines(item: LoggedLines, shows_label: bool) -> Json:
    lines = [_line(line, item.color, item.width_m) for line in item.lines]
    middles = [line.mean(0).tolist() for line in item.lines] if shows_label else []
    texts = [_text(item.label, middle, item.color) for middle in middles]
    return _entity(item.name, item.metadata, lines=lines, texts=texts)


def _nest(numbers: Mapping[str, float]) -> Json:
    """Return numbers by path as nested objects; those that are not finite are left out."""
    found: Json = {}
    for path, value in numbers.items():
        *groups, name = path.split("/")
        place = found
        for group in groups:
            place = place.setdefault(group, {})
        if math.isfinite(value):
            place[name] = float(value)
    return found
