# SPDX-License-Identifier: Apache-2.0
"""Frames for the viewer Foxglove (https://foxglove.dev): an MCAP file of its JSON schemas.

| topic | schema | content |
|---|---|---|
| `/tf` | FrameTransform | stated pose of each agent, from `world` to `agent_ID` |
| `/agents/ID/cloud` | PointCloud | x, y, z, intensity in `agent_ID` |
| `/ego/boxes`, `/truth` | SceneUpdate | boxes in `world`, coloured as in ``viz.spatial_frame``, with scores as metadata |
| `/links` | SceneUpdate | messages from agent to agent, grey when late |
| `/corrections` | SceneUpdate | lines from stated to corrected positions |
| `/map` | SceneUpdate | map elements |
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
from manyeyes.viz.spatial_frame import BOX_COLORS, Floats, ShownAgent, ShownBoxes, ShownLink, SpatialFrame

MAX_POINTS = 30_000
"""Points of a cloud that are written; of longer ones every n-th."""
LATE_MS = 200.0
_FLOAT32, _INFO, _LINE_STRIP = 7, 2, 0
_LATE_COLOR, _LINK_COLOR, _CORRECTION_COLOR, _MAP_COLOR = (
    (120, 120, 120),
    (255, 255, 255),
    (255, 90, 200),
    (200, 200, 90),
)
Json = dict[str, Any]


def _object(**properties: Json) -> Json:
    return {"type": "object", "properties": properties}


def _array(items: Json) -> Json:
    return {"type": "array", "items": items}


_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
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

    def __init__(self, path: Path) -> None:
        writer = import_extra("mcap.writer", "live", "Writing a file for Foxglove")
        self._files, self._channels = ExitStack(), dict[str, int]()
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
        """Write one instant."""
        now_ns = frame.capture_ns
        for agent in frame.agents:
            self._add_agent(agent, now_ns)
        self._add_scene("/ego/boxes", now_ns, _make_cubes(frame.boxes))
        if frame.truth is not None:
            self._add_scene("/truth", now_ns, _make_cubes(frame.truth))
        positions = {agent.agent_id: agent.world_from_agent.translation.numpy() for agent in frame.agents}
        links = [
            _make_link(link, np.stack((positions[link.sender], positions[link.receiver])))
            for link in frame.links
            if link.sender in positions and link.receiver in positions
        ]
        self._add_scene("/links", now_ns, links)
        moved = [
            _entity(f"agent {agent.agent_id}", lines=[_make_correction(agent.world_from_agent, agent.corrected)])
            for agent in frame.agents
            if agent.corrected is not None
        ]
        self._add_scene("/corrections", now_ns, moved)
        if frame.map_lines:
            elements = [
                _entity(kind, lines=[_line(_lift(line), _MAP_COLOR) for line in lines])
                for kind, lines in frame.map_lines.items()
            ]
            self._add_scene("/map", now_ns, elements)
        if frame.numbers:
            self._write("/plots", "manyeyes.Plots", now_ns, _nest(frame.numbers))
        for text in frame.events:
            log = {"timestamp": _time(now_ns), "level": _INFO, "message": text, "name": "manyeyes"}
            self._write("/events", "foxglove.Log", now_ns, log)

    def _add_agent(self, agent: ShownAgent, now_ns: int) -> None:
        name, pose = f"agent_{agent.agent_id}", agent.world_from_agent
        transform = {
            "timestamp": _time(now_ns),
            "parent_frame_id": "world",
            "child_frame_id": name,
            "translation": _vector(pose.translation.tolist()),
            "rotation": _quaternion(pose),
        }
        self._write("/tf", "foxglove.FrameTransform", now_ns, transform)
        if agent.points is None:
            return
        step = max(1, -(-len(agent.points) // MAX_POINTS))
        intensity = np.ones(len(agent.points)) if agent.intensity is None else agent.intensity
        rows = np.ascontiguousarray(np.column_stack((agent.points, intensity))[::step], "<f4")
        names = ("x", "y", "z", "intensity")
        cloud = {
            "timestamp": _time(now_ns),
            "frame_id": name,
            "pose": _pose((0.0, 0.0, 0.0)),
            "point_stride": 16,
            "fields": [{"name": field, "offset": 4 * k, "type": _FLOAT32} for k, field in enumerate(names)],
            "data": base64.b64encode(rows.tobytes()).decode(),
        }
        self._write(f"/agents/{agent.agent_id}/cloud", "foxglove.PointCloud", now_ns, cloud)

    def _add_scene(self, topic: str, now_ns: int, entities: Sequence[Json]) -> None:
        """Replace the entities of a topic."""
        stamp = _time(now_ns)
        update = {
            "deletions": [{"timestamp": stamp, "type": _DELETE_ALL, "id": ""}],
            "entities": [{"timestamp": stamp, "frame_id": "world", **entity} for entity in entities],
        }
        self._write(topic, "foxglove.SceneUpdate", now_ns, update)

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


def _color(rgb: tuple[int, int, int], alpha: float = 1.0) -> Json:
    return {**dict(zip("rgb", (value / 255 for value in rgb))), "a": alpha}


def _entity(name: str, metadata: Mapping[str, str] | None = None, **primitives: list[Json]) -> Json:
    """Return an entity without time and frame; it stays until it is replaced."""
    pairs = [{"key": key, "value": value} for key, value in (metadata or {}).items()]
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    every = {kind: primitives.get(kind, []) for kind in kinds}
    return {"id": name, "lifetime": _time(0), "frame_locked": False, "metadata": pairs, **every}


def _line(points: Floats, color: tuple[int, int, int], thickness_m: float = 0.1) -> Json:
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


def _make_cubes(shown: ShownBoxes) -> list[Json]:
    boxes = shown.boxes
    columns = (boxes.center.tolist(), boxes.size.tolist(), boxes.yaw.tolist(), boxes.score.tolist(), boxes.id.tolist())
    found = list[Json]()
    for row, (center, size, yaw, score, number, kind) in enumerate(zip(*columns, shown.kinds)):
        cube = {"pose": _pose(center, yaw), "size": _vector(size), "color": _color(BOX_COLORS[kind], 0.5)}
        metadata = {"score": f"{score:.2f}", "kind": kind, **({"id": str(number)} if number >= 0 else {})}
        found.append(_entity(str(row), metadata, cubes=[cube]))
    return found


def _make_link(link: ShownLink, ends: Floats) -> Json:
    color = _LATE_COLOR if link.age_ms > LATE_MS else _LINK_COLOR
    metadata = {"bytes": str(link.num_bytes), "age_ms": f"{link.age_ms:.0f}"}
    return _entity(f"{link.sender}-{link.receiver}", metadata, lines=[_line(ends, color)])


def _make_correction(stated: Transform, corrected: Transform) -> Json:
    ends = np.stack((stated.translation.double().numpy(), corrected.translation.double().numpy()))
    return _line(ends, _CORRECTION_COLOR)


def _lift(line: Floats) -> Floats:
    return np.column_stack((line, np.zeros(len(line))))


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
