# SPDX-License-Identifier: Apache-2.0
"""Snapshots to disk in OPV2V's layout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manyeyes.datasets.formats.image_io import write_png
from manyeyes.datasets.formats.pcd import write_float_pcd, write_pcd
from manyeyes.datasets.opv2v.camera import camera_yaml, image_path
from manyeyes.datasets.opv2v.carla import carla_from_transform, mirror_points, transform_from_carla
from manyeyes.datasets.opv2v.metadata import KMH_PER_MPS, AgentRecord, write_protocol, write_record
from manyeyes.datatypes import Boxes, RecordingError, Snapshot, Transform


class Opv2vWriter:
    """Writes one scenario's folder, so that :class:`Opv2vRecording` reads the same snapshots back.

    Exact to rounding: poses and boxes as float64 text, points as float32, intensity in 8 bits as OPV2V has it, or as
    float32. Not in the format, hence not written: the time of a point, boxes that no agent lists, the covariance of a
    prior pose. The true pose goes to ``lidar_pose``, the prior one to ``predicted_ego_pos``, which the reader does not
    use. Snapshots come back with agents in string order of their ids, infrastructure (negative ids) last, and boxes in
    the order of ids.

    OPV2V lists no agent's body as a vehicle (OpenCOOD, number 141 of its tracker), so that readers of OPV2V count none as truth.
    The bodies that an agent has seen are therefore written beside its ``vehicles``, under ``agent_bodies``, which
    :class:`Opv2vRecording` reads and others skip. lists_agents: write them under ``vehicles``, as V2XSet does.
    """

    def __init__(
        self,
        folder: Path | str,
        fixed_delta_s: float = 0.05,
        digits: int = 6,
        has_float_intensity: bool = False,
        lists_agents: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self._fixed_delta_s = fixed_delta_s
        self._digits = digits
        self._lists_agents = lists_agents
        self._write_cloud = write_float_pcd if has_float_intensity else write_pcd
        self.folder.mkdir(parents=True, exist_ok=True)

    def write(self, snapshot: Snapshot, box_speed_mps: torch.Tensor | None = None) -> None:
        """Write one instant of all agents; box_speed_mps: (N,) of truth.boxes, zero where it is not given."""
        _check_ids(snapshot)
        for row, frame in enumerate(snapshot.frames):
            steps = frame.timestamp_ns * 1e-9 / self._fixed_delta_s
            if abs(steps - round(steps)) > 1e-3:
                raise RecordingError(
                    f"{self.folder}: agent {frame.agent_id} has time {frame.timestamp_ns} ns, expected a multiple "
                    f"of {self._fixed_delta_s} s, for OPV2V names files by steps; choose another fixed_delta_s."
                )
            folder = self.folder / str(frame.agent_id)
            folder.mkdir(exist_ok=True)
            stem = f"{round(steps):0{self._digits}d}"
            xyz = mirror_points(frame.points.xyz.numpy())
            xyz[:, 2] -= np.float32(frame.sensor_height_m)
            self._write_cloud(folder / f"{stem}.pcd", xyz, frame.points.intensity.numpy())
            record, cameras = _record_of(snapshot, row, box_speed_mps), {}
            true_pose = transform_from_carla(record.ego_pose), transform_from_carla(record.lidar_pose)
            for number, image in enumerate(frame.images):
                write_png(image_path(folder, stem, number), image.rgb)
                cameras |= camera_yaml(number, image.camera, *true_pose)
            # Last, so that a yaml without its cloud never comes of an interrupted run.
            apart = () if self._lists_agents else [other.agent_id for other in snapshot.frames]
            write_record(folder / f"{stem}.yaml", record, carla_from_transform(frame.world_from_agent), cameras, apart)

    def close(self, protocol: Mapping[str, Any]) -> None:
        """Write data_protocol.yaml; ``history_frames`` is the number of first frames that are not evaluated."""
        write_protocol(self.folder, protocol, self._fixed_delta_s)


def _check_ids(snapshot: Snapshot) -> None:
    agents = [f.agent_id for f in snapshot.frames]
    boxes = snapshot.truth.boxes.id.tolist() if snapshot.truth is not None else []
    if len(set(agents)) < len(agents) or len(set(boxes)) < len(boxes) or any(id < 0 for id in boxes):
        name = f"Snapshot {snapshot.index} of '{snapshot.scenario}'"
        raise RecordingError(
            f"{name} has agents {agents} and boxes {boxes}: OPV2V needs ids that occur once, boxes' >= 0."
        )
    for frame in snapshot.frames:
        if frame.is_infrastructure != (frame.agent_id < 0):
            kind = "infrastructure" if frame.is_infrastructure else "a vehicle"
            raise RecordingError(
                f"Agent {frame.agent_id} is {kind}: OPV2V gives infrastructure, and nothing else, ids < 0."
            )


def _record_of(snapshot: Snapshot, row: int, box_speed_mps: torch.Tensor | None) -> AgentRecord:
    frame, truth = snapshot.frames[row], snapshot.truth
    world_from_agent = frame.world_from_agent if truth is None else truth.world_from_agent[row]
    boxes = Boxes.empty(torch.float64)
    speed = torch.zeros(0)
    if truth is not None:
        listed = truth.seen[row] & (truth.boxes.id != frame.agent_id)
        boxes = truth.boxes[listed].to(torch.float64)
        speed = torch.zeros(len(boxes)) if box_speed_mps is None else box_speed_mps[listed]
    size, middle = boxes.size.numpy(), boxes.center.numpy() * (1, -1, 1)
    above = np.zeros_like(size)
    above[:, 2] = size[:, 2] / 2
    angle = np.zeros_like(size)
    angle[:, 1] = -np.degrees(boxes.yaw.numpy())
    return AgentRecord(
        lidar_pose=carla_from_transform(world_from_agent @ Transform.from_xyz_yaw(0, 0, frame.sensor_height_m)),
        ego_pose=carla_from_transform(world_from_agent),
        speed_kmh=frame.speed_mps * KMH_PER_MPS,
        is_infrastructure=frame.is_infrastructure,
        id=boxes.id.numpy(),
        label=boxes.label.numpy(),
        location=middle - above,
        center=above,
        extent=size / 2,
        angle=angle,
        speed=speed.double().numpy() * KMH_PER_MPS,
        link=np.full(len(boxes), -1),
        has_matrix=False,
        has_links=False,
        has_named_types=False,
    )
