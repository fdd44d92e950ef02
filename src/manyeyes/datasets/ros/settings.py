# SPDX-License-Identifier: Apache-2.0
"""``ros.toml``: which topics of a bag belong to which agent.

Keys at the top: ``bags`` (a list of paths in the folder of the file: rosbag2 folders, ``.mcap``, ``.db3`` or ``.bag``),
``max_pose_gap_ms`` (200: two poses farther apart are not interpolated). One table ``[[agent]]`` for each, the ego first: ``id``,
``points`` (topic), then ``pose`` (topic) or ``tf`` (names of the world's and the LiDAR's frame). Optional: ``body_from_lidar``
(x, y, z, roll, pitch, yaw of the LiDAR in the frame of the pose), ``sensor_height_m``, ``is_infrastructure`` (id below 0),
``intensity_max`` (255), ``boxes`` (a table as in plain folders), ``body`` (x, y of the middle of the vehicle's body ahead and to
the left of the LiDAR, then its length, width, height).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from manyeyes._io import read_file
from manyeyes.datasets.lidar_frame import make_body
from manyeyes.datatypes import AgentBody, RecordingError, Transform
from manyeyes.datatypes.errors import shorten

SETTINGS = "ros.toml"
_MAX_BYTES = 1 << 20
_MAX_AGENTS = 100


@dataclass(frozen=True)
class AgentTopics:
    """One agent of a bag. pose: the topic of its poses, or None where tf has the names of the world's and the LiDAR's frame."""

    id: int
    points: str
    pose: str | None
    tf: tuple[str, str] | None
    body_from_lidar: Transform
    sensor_height_m: float | None
    is_infrastructure: bool
    intensity_max: float | None
    boxes: Path | None
    body: AgentBody | None


@dataclass(frozen=True)
class RosSettings:
    """Content of one ros.toml. bags: paths that exist."""

    path: Path
    bags: tuple[Path, ...]
    max_pose_gap_ns: int
    agents: tuple[AgentTopics, ...]

    @classmethod
    def read(cls, path: Path) -> RosSettings:
        """Read a file; an unknown key, a missing bag and a value of another type are errors that name it."""
        try:
            content = tomllib.loads(read_file(path, _MAX_BYTES).decode())
        except (OSError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or " ".join(str(error).split())
            raise RecordingError(f"{path}: expected TOML ({reason}); correct it.") from None
        top = _Keys(path, content, "")
        names = top.take("bags", _is_names, "a list of file names")
        gap_ms = top.take("max_pose_gap_ms", _is_positive, "milliseconds above 0", 200.0)
        agents = top.take("agent", lambda v: isinstance(v, list) and 0 < len(v) <= _MAX_AGENTS, "tables [[agent]]")
        top.finish()
        bags = tuple(path.parent / name for name in names)
        missing = [bag for bag in bags if not bag.exists()]
        if missing:
            raise RecordingError(f"{path}: no bag {missing[0]}; correct 'bags', or copy the bag there.")
        parsed = tuple(_read_agent(path, agent, f"agent[{n}]") for n, agent in enumerate(agents))
        if len({agent.id for agent in parsed}) < len(parsed):
            raise RecordingError(f"{path}: two agents have one id; give each its own.")
        return cls(path, bags, round(float(gap_ms) * 1e6), parsed)


@dataclass
class _Keys:
    """The keys of a table that are not taken yet."""

    path: Path
    content: Any
    where: str

    def take(self, key: str, is_valid: Callable[[Any], bool], expected: str, default: Any = ...) -> Any:
        name = f"{self.where}.{key}" if self.where else key
        if not isinstance(self.content, dict):
            raise RecordingError(
                f"{self.path}: expected a table at '{self.where}', found {shorten(self.content)}; correct it."
            )
        if key not in self.content and default is not ...:
            return default
        found = self.content.pop(key, None)
        if found is None or not is_valid(found):
            raise RecordingError(f"{self.path}: expected {expected} at '{name}', found {shorten(found)}; correct it.")
        return found

    def finish(self) -> None:
        if self.content:
            key = next(iter(self.content))
            name = f"{self.where}.{key}" if self.where else key
            raise RecordingError(f"{self.path}: unknown key '{name}'; remove it, or see docs/guides/own-data.md.")


def _read_agent(path: Path, content: Any, where: str) -> AgentTopics:
    keys = _Keys(path, dict(content) if isinstance(content, Mapping) else content, where)
    id = keys.take("id", lambda v: isinstance(v, int) and not isinstance(v, bool) and abs(v) < 2**31, "a whole number")
    points = keys.take("points", _is_name, "the name of a topic")
    pose = keys.take("pose", _is_name, "the name of a topic", None)
    tf = keys.take("tf", lambda v: _is_names(v) and len(v) == 2, "two names of frames", None)
    if (pose is None) == (tf is None):
        raise RecordingError(
            f"{path}: expected either 'pose' or 'tf' at '{where}'; name a topic, or the world's and the LiDAR's frame."
        )
    mount = keys.take(
        "body_from_lidar", lambda v: _is_numbers(v, 6), "six numbers x, y, z, roll, pitch, yaw", [0.0] * 6
    )
    height = keys.take("sensor_height_m", _is_positive, "metres above 0", None)
    is_infrastructure = keys.take("is_infrastructure", lambda v: isinstance(v, bool), "true or false", id < 0)
    intensity_max = keys.take("intensity_max", _is_positive, "a number above 0", None)
    boxes = keys.take("boxes", _is_name, "the name of a table", None)
    body = keys.take("body", lambda v: _is_numbers(v, 5), "five numbers x, y, length, width, height", None)
    keys.finish()
    values = torch.tensor([float(v) for v in mount], dtype=torch.float64)
    return AgentTopics(
        id, points, pose, None if tf is None else (tf[0], tf[1]), Transform.from_rpy(values[:3], *values[3:]),
        height, is_infrastructure, intensity_max, None if boxes is None else path.parent / boxes,
        None if body is None else make_body(path, f"{where}.body", [float(v) for v in body]),
    )  # fmt: skip


def _is_name(found: Any) -> bool:
    return isinstance(found, str) and bool(found)


def _is_names(found: Any) -> bool:
    return isinstance(found, list) and bool(found) and all(map(_is_name, found))


def _is_numbers(found: Any, count: int) -> bool:
    return isinstance(found, list) and len(found) == count and all(_is_number(v) for v in found)


def _is_number(found: Any) -> bool:
    return (
        isinstance(found, (int, float)) and not isinstance(found, bool) and abs(found) < 1e12 and math.isfinite(found)
    )


def _is_positive(found: Any) -> bool:
    return _is_number(found) and found > 0
