# SPDX-License-Identifier: Apache-2.0
"""Frames for the viewer rerun (https://rerun.io): saved to a file, or streamed to a running viewer or to a web viewer.

The groups of ``viz.spatial_entities`` stand under `world/GROUP/NAME`, clouds under `world/agents/ID/cloud`, numbers under
`plots/PATH`, text under `events`. What an instant no longer has is cleared.

Timelines: `tick`, `capture` (time of the sweep) and, for messages, `arrival`.
"""

from __future__ import annotations

import socket
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch

from manyeyes._io import atomic_replace
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.extras import import_extra
from manyeyes.viz.rerun_server import RerunServer, is_web_target
from manyeyes.viz.spatial_entities import (
    LINK_HEIGHT_M,
    AgentGroup,
    BoxGroup,
    CloudColor,
    LineGroup,
    LoggedAgent,
    NumberGroup,
    SpatialDescription,
)
from manyeyes.viz.spatial_frame import ShownAgent, SpatialFrame

SUFFIX, URL_PREFIX = ".rrd", "rerun+http"
_CONNECT_S, _RETRY_S, _FLUSH_S, _POINT_PIXELS = 3.0, 0.2, 60.0, 1.2
_EYE_M = (-35.0, 0.0, 30.0)
"""Position of the camera of the layout, in the frame of the first agent."""
_PLOTS = {"bytes": "Bytes of messages", "age_ms": "Age of messages, ms", "counts": "Boxes: matched, false, missed"}
"""Plots of the layout: title by path; others can be added in the viewer."""


class RerunLog:
    """Logs frames to a file, a viewer, or a web viewer.

    target: FILE.rrd, which appears when the log is closed; rerun+http://HOST:PORT/proxy of a viewer that runs; web or web:PORT, the
    web viewer, which is started on this machine and ends when the log is closed.

    Raises:
        ConfigError: the target is none of these, no viewer answers, or the port of the web viewer is taken.
        MissingExtraError: rerun is not installed.
    """

    def __init__(self, target: str, name: str = "manyeyes", cloud_color: CloudColor = "agent") -> None:
        is_file = target.endswith(SUFFIX)
        if not is_file and not is_web_target(target) and not target.startswith(URL_PREFIX):
            raise ConfigError(
                f"A target of the viewer is a file {SUFFIX}, web or web:PORT for the web viewer, or {URL_PREFIX}://HOST:PORT/proxy "
                f"of a running viewer; got {target!r}."
            )
        self._rerun = import_extra("rerun", "rerun", "Logging for the viewer")
        self._description, self._shown = SpatialDescription(cloud_color), dict[str, set[str]]()
        self._has_layout, self._colored = False, set[str]()
        self._target, self._is_file, self._is_pending = target, is_file, True
        self.server: RerunServer | None = None
        with ExitStack() as resources:
            self._stream: Any = self._rerun.RecordingStream("manyeyes")
            if is_file:
                draft = resources.enter_context(atomic_replace(Path(target), keep_suffix=True))
                self._stream.save(str(draft))
            else:
                if is_web_target(target):
                    self.server = resources.enter_context(RerunServer(target))
                url = target if self.server is None else self.server.url
                _check_answers(url)
                self._stream.connect_grpc(url)
            self._resources = resources.pop_all()
        self._stream.send_recording_name(name)
        self._stream.log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def __enter__(self) -> RerunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._is_pending:
                self.flush()
        except BaseException as failure:
            # A file that is not whole must not get its name.
            self._stream.disconnect()
            self._resources.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._stream.disconnect()
        self._resources.__exit__(kind, error, trace)

    def flush(self) -> None:
        """Wait until all that was logged is written, or was received by the viewer.

        Raises:
            ConfigError: the file cannot be written, or the viewer no longer answers.
        """
        try:
            self._stream.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            if self._is_file:
                text = f"{self._target}: not all frames could be written ({error}); free space on its disk, and repeat."
            else:
                text = f"The viewer did not take all frames ({error}); start it again, and repeat."
            raise ConfigError(text) from error
        self._is_pending = False

    def add(self, frame: SpatialFrame) -> None:
        """Log the frame of one instant."""
        self._is_pending = True
        stream = self._stream
        if not self._has_layout and frame.agents:
            stream.send_blueprint(_make_layout(frame.agents[0]))
            self._has_layout = True
        stream.reset_time()
        stream.set_time("tick", sequence=frame.index)
        stream.set_time("capture", timestamp=np.datetime64(frame.capture_ns, "ns"))
        for entity in self._description.describe(frame):
            match entity:
                case AgentGroup():
                    self._replace("agents", {agent.name for agent in entity.items})
                    for agent in entity.items:
                        self._add_agent(agent)
                case BoxGroup():
                    self._add_cubes(entity)
                case LineGroup():
                    self._add_lines(entity)
                case NumberGroup():
                    self._add_numbers(entity)
                case _:
                    for line in entity.lines:
                        stream.log("events", self._rerun.TextLog(line))

    def _add_numbers(self, numbers: NumberGroup) -> None:
        for path in numbers.colors.keys() - self._colored:
            name = path.rpartition("/")[2]
            style = self._rerun.SeriesLines(colors=[numbers.colors[path]], names=[name], widths=[2.0])
            self._stream.log(f"plots/{path}", style, static=True)
        self._colored |= numbers.colors.keys()
        for path, value in numbers.values.items():
            self._stream.log(f"plots/{path}", self._rerun.Scalars(float(value)))

    def _replace(self, group: str, names: set[str]) -> None:
        """Clear what a group had and no longer has: else a viewer shows it on."""
        for name in sorted(self._shown.get(group, set()) - names):
            self._stream.log(f"world/{group}/{name}", self._rerun.Clear(recursive=True))
        self._shown[group] = names

    def _add_agent(self, agent: LoggedAgent) -> None:
        rerun, path, pose = self._rerun, f"world/agents/{agent.name}", agent.world_from_agent
        self._stream.log(path, rerun.Transform3D(translation=pose.translation.numpy(), mat3x3=pose.rotation.numpy()))
        label = rerun.Points3D(
            [[0.0, 0.0, LINK_HEIGHT_M]],
            colors=[agent.color],
            labels=[f"agent {agent.name}"],
            radii=0.4,
            show_labels=True,
        )
        self._stream.log(f"{path}/name", label)
        if agent.cloud is not None:
            points = rerun.Points3D(
                agent.cloud.points, colors=agent.cloud.colors, radii=rerun.Radius.ui_points(_POINT_PIXELS)
            )
            self._stream.log(f"{path}/cloud", points)

    def _add_cubes(self, cubes: BoxGroup) -> None:
        half_yaw = cubes.boxes.yaw.double().numpy() / 2
        boxes = self._rerun.Boxes3D(
            centers=cubes.boxes.center.numpy(),
            half_sizes=cubes.boxes.size.numpy() / 2,
            quaternions=np.stack((0 * half_yaw, 0 * half_yaw, np.sin(half_yaw), np.cos(half_yaw)), 1),
            colors=cubes.colors,
            labels=list(cubes.labels),
            show_labels=cubes.shows_labels,
        )
        self._stream.log(f"world/{cubes.group}", boxes)

    def _add_lines(self, lines: LineGroup) -> None:
        rerun = self._rerun
        self._replace(lines.group, {item.name for item in lines.items})
        for item in lines.items:
            path, style = f"world/{lines.group}/{item.name}", {"radii": item.width_m / 2, "colors": [item.color]}
            labels, shown = [item.label] * len(item.lines), {"show_labels": lines.shows_labels}
            if lines.are_arrows:
                origins, vectors = zip(*((line[0], line[-1] - line[0]) for line in item.lines))
                drawn = rerun.Arrows3D(origins=origins, vectors=vectors, labels=labels, **shown, **style)
            else:
                drawn = rerun.LineStrips3D(list(item.lines), labels=labels, **shown, **style)
            if item.arrival_ns is not None:
                self._stream.set_time("arrival", timestamp=np.datetime64(item.arrival_ns, "ns"))
            self._stream.log(path, drawn)
            self._stream.disable_timeline("arrival")


def _check_answers(url: str) -> None:
    """Wait for a moment until something listens at the address, as where both are started at once.

    Raises:
        ConfigError: nothing does: the viewer's own connection would wait without an error.
    """
    end = time.monotonic() + _CONNECT_S
    while True:
        try:
            parts = urlsplit(url)
            with socket.create_connection((parts.hostname or "", parts.port or 0), timeout=_CONNECT_S):
                return
        except (OSError, ValueError) as error:
            if not isinstance(error, ConnectionError) or time.monotonic() > end:
                remedy = f"start one with 'rerun', or save a file {SUFFIX}"
                raise ConfigError(f"{url}: no viewer answers ({error}); {remedy}.") from error
        time.sleep(_RETRY_S)


def _make_layout(ego: ShownAgent) -> Any:
    """Return the arrangement of views: the scene about the ego, beside it plots and events; the time line is that of sweeps."""
    views = import_extra("rerun.blueprint", "rerun", "Logging for the viewer")
    eye = ego.world_from_agent.apply(torch.tensor([_EYE_M], dtype=torch.float64))[0]
    controls = views.EyeControls3D(
        position=eye.tolist(),
        look_target=ego.world_from_agent.translation.tolist(),
        eye_up=(0.0, 0.0, 1.0),
        tracking_entity=f"world/agents/{ego.agent_id}",
    )
    scene = views.Spatial3DView(origin="world", name="Scene", background=(20, 22, 26), eye_controls=controls)
    plots = [views.TimeSeriesView(origin=f"plots/{path}", name=name) for path, name in _PLOTS.items()]
    side = views.Vertical(*plots, views.TextLogView(origin="events", name="Events"))
    return views.Blueprint(
        views.Horizontal(scene, side, column_shares=[3, 1]),
        views.TimePanel(timeline="tick", state="collapsed"),
        views.SelectionPanel(state="collapsed"),
        views.BlueprintPanel(state="collapsed"),
    )
