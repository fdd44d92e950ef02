# SPDX-License-Identifier: Apache-2.0
"""Frames for the viewer rerun (https://rerun.io): saved to a file, or streamed to a running viewer.

| entity | content |
|---|---|
| `world/agents/ID` | stated pose; below it `cloud` |
| `world/corrections/ID` | arrow from the stated to the corrected position |
| `world/ego/boxes` | boxes with ids and scores, coloured by match with the truth, or by evidence |
| `world/truth` | true boxes; missed ones in another colour |
| `world/links/A-B` | messages, wider by bytes, grey when late |
| `world/map/KIND` | map elements |
| `plots/...` | numbers over time |
| `events` | lines of text |

Timelines: `tick`, `capture` (time of the sweep) and, for links, `arrival`.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes._io import atomic_rename
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.extras import import_extra
from manyeyes.viz.spatial_frame import BOX_COLORS, ShownAgent, ShownBoxes, ShownLink, SpatialFrame

SUFFIX, URL_PREFIX = ".rrd", "rerun+http"
MAX_POINTS = 30_000
"""Points of a cloud that are shown; of longer ones every n-th."""
LATE_MS = 200.0
_AGENT_COLORS = ((90, 170, 255), (255, 170, 60), (120, 220, 120), (220, 120, 220), (240, 220, 90), (110, 220, 220))
_LATE_COLOR, _LINK_COLOR, _CORRECTION_COLOR = (120, 120, 120), (255, 255, 255), (255, 90, 200)
_BYTES_PER_CM = 1_000.0


class RerunLog:
    """Logs frames to a file (.rrd) that appears when the log is closed, or to a viewer (rerun+http://HOST:PORT/proxy).

    Raises:
        ConfigError: the target is neither.
        MissingExtraError: rerun is not installed.
    """

    def __init__(self, target: str, name: str = "manyeyes") -> None:
        is_file = target.endswith(SUFFIX)
        if not is_file and not target.startswith(URL_PREFIX):
            raise ConfigError(
                f"A target of the viewer is a file {SUFFIX}, or {URL_PREFIX}://HOST:PORT/proxy; got {target!r}."
            )
        self._rerun = import_extra("rerun", "rerun", "Logging for the viewer")
        self._stream: Any = self._rerun.RecordingStream("manyeyes")
        self._file = Path(target) if is_file else None
        if self._file is not None:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._draft = self._file.with_name(f"{self._file.stem}.partial{SUFFIX}")
            self._stream.save(str(self._draft))
        else:
            self._stream.connect_grpc(target)
        self._stream.send_recording_name(name)
        self._stream.log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def __enter__(self) -> RerunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()
        if self._file is not None:
            if kind is None:
                atomic_rename(self._draft, self._file)
            else:
                self._draft.unlink(missing_ok=True)

    def add(self, frame: SpatialFrame) -> None:
        """Log one instant."""
        rerun, stream = self._rerun, self._stream
        stream.reset_time()
        stream.set_time("tick", sequence=frame.index)
        stream.set_time("capture", timestamp=np.datetime64(frame.capture_ns, "ns"))
        for number, agent in enumerate(frame.agents):
            self._add_agent(agent, _AGENT_COLORS[number % len(_AGENT_COLORS)])
        self._add_boxes("world/ego/boxes", frame.boxes)
        if frame.truth is not None:
            self._add_boxes("world/truth", frame.truth)
        for kind, lines in frame.map_lines.items():
            strips = [np.column_stack((line, np.zeros(len(line)))) for line in lines]
            stream.log(f"world/map/{kind}", rerun.LineStrips3D(strips, radii=0.05))
        for path, value in frame.numbers.items():
            stream.log(f"plots/{path}", rerun.Scalars(float(value)))
        for text in frame.events:
            stream.log("events", rerun.TextLog(text))
        positions = {agent.agent_id: agent.world_from_agent.translation.tolist() for agent in frame.agents}
        for link in frame.links:
            if link.sender in positions and link.receiver in positions:
                self._add_link(link, positions[link.sender], positions[link.receiver])

    def _add_agent(self, agent: ShownAgent, color: tuple[int, int, int]) -> None:
        rerun, path, pose = self._rerun, f"world/agents/{agent.agent_id}", agent.world_from_agent
        self._stream.log(path, rerun.Transform3D(translation=pose.translation.numpy(), mat3x3=pose.rotation.numpy()))
        if agent.points is not None:
            step = max(1, -(-len(agent.points) // MAX_POINTS))
            colors = _shade(color, agent.intensity, len(agent.points))
            self._stream.log(f"{path}/cloud", rerun.Points3D(agent.points[::step], colors=colors[::step], radii=0.03))
        if agent.corrected is not None:
            offset = (agent.corrected.translation - pose.translation).numpy()
            arrow = rerun.Arrows3D(
                origins=[pose.translation.numpy()], vectors=[offset], colors=[_CORRECTION_COLOR], radii=0.1
            )
            self._stream.log(f"world/corrections/{agent.agent_id}", arrow)

    def _add_boxes(self, path: str, shown: ShownBoxes) -> None:
        boxes = shown.boxes
        half_yaw = boxes.yaw.double().numpy() / 2
        quaternions = np.stack((0 * half_yaw, 0 * half_yaw, np.sin(half_yaw), np.cos(half_yaw)), 1)
        labels = [
            " ".join((*((f"{number}",) if number >= 0 else ()), f"{score:.2f}", kind))
            for number, score, kind in zip(boxes.id.tolist(), boxes.score.tolist(), shown.kinds)
        ]
        self._stream.log(
            path,
            self._rerun.Boxes3D(
                centers=boxes.center.numpy(),
                half_sizes=boxes.size.numpy() / 2,
                quaternions=quaternions,
                colors=np.array([BOX_COLORS[kind] for kind in shown.kinds], np.uint8).reshape(-1, 3),
                labels=labels,
                show_labels=False,
            ),
        )

    def _add_link(self, link: ShownLink, sender: list[float], receiver: list[float]) -> None:
        if link.arrival_ns is not None:
            self._stream.set_time("arrival", timestamp=np.datetime64(link.arrival_ns, "ns"))
        color = _LATE_COLOR if link.age_ms > LATE_MS else _LINK_COLOR
        strip = self._rerun.LineStrips3D(
            [[sender, receiver]],
            radii=max(0.02, 0.01 * link.num_bytes / _BYTES_PER_CM),
            colors=[color],
            labels=[f"{link.num_bytes} B, {link.age_ms:.0f} ms"],
        )
        self._stream.log(f"world/links/{link.sender}-{link.receiver}", strip)


def _shade(color: tuple[int, int, int], intensity: NDArray[np.float32] | None, count: int) -> NDArray[np.uint8]:
    """Return the colour of an agent, brighter by intensity: (N, 3)."""
    light = np.full(count, 1.0) if intensity is None else 0.4 + 0.6 * np.clip(intensity, 0.0, 1.0)
    return (np.array(color)[None] * light[:, None]).astype(np.uint8)
