# SPDX-License-Identifier: Apache-2.0
"""From what formats store, a cloud and the pose of its LiDAR, to the frame and the truth of agents."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from manyeyes.datasets.formats.pcd import PcdCloud
from manyeyes.datatypes import (
    AgentBody,
    AgentFrame,
    Boxes,
    GroundTruth,
    PointCloud,
    RecordingError,
    ShapeError,
    Transform,
)


def rotation_of_quaternion(quaternion: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) as w, x, y, z, of any length but 0."""
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def make_lidar_frame(
    cloud: PcdCloud,
    world_from_lidar: Transform,
    sensor_height_m: float,
    agent_id: int = 0,
    timestamp_ns: int = 0,
    speed_mps: float = 0.0,
    is_infrastructure: bool = False,
    body: AgentBody | None = None,
) -> AgentFrame:
    """Return the frame of an agent whose origin lies on the road, sensor_height_m below its LiDAR along the LiDAR's z axis.

    cloud: in the LiDAR's frame, x ahead, y left. Points at the LiDAR itself, which are no returns, are dropped. Times of points
    that are not within a second of timestamp_ns are zero: they count by another clock. body: in the frame that is returned.
    """
    met = cloud.xyz.any(axis=1)
    xyz = cloud.xyz[met]
    xyz[:, 2] += np.float32(sensor_height_m)
    time_s = None
    if cloud.time_s is not None:
        relative = cloud.time_s[met] - timestamp_ns * 1e-9
        time_s = torch.from_numpy(np.where(np.abs(relative) < 1, relative, 0.0).astype(np.float32))
    return AgentFrame(
        agent_id=agent_id,
        timestamp_ns=timestamp_ns,
        points=PointCloud.of(torch.from_numpy(xyz), torch.from_numpy(np.clip(cloud.intensity[met], 0, 1)), time_s),
        world_from_agent=world_from_lidar @ Transform.from_xyz_yaw(0, 0, -sensor_height_m),
        pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
        sensor_height_m=sensor_height_m,
        speed_mps=speed_mps,
        is_infrastructure=is_infrastructure,
        body=body,
    )


def make_body(path: Path, where: str, values: Sequence[float]) -> AgentBody:
    """Return a body that stands on the road: x, y of its middle in the agent's frame, then length, width, height, metres.

    Raises:
        RecordingError: a number is out of bounds; where: what is named in the text.
    """
    x, y, length, width, height = values
    try:
        return AgentBody.standing(x, y, (length, width, height))
    except ShapeError as error:
        raise RecordingError(f"{path}: {where} is no body of a vehicle ({error}); correct it.") from None


def merge_listed_boxes(listed: Sequence[Boxes], frames: Sequence[AgentFrame]) -> GroundTruth:
    """Return the union of what each agent lists, in the world, by id: first agent's copy, in the order of ids."""
    both = Boxes.cat([boxes.to(torch.float64) for boxes in listed])
    id, first = np.unique(both.id.numpy(), return_index=True)
    seen = torch.stack([torch.from_numpy(np.isin(id, boxes.id.numpy())) for boxes in listed])
    return GroundTruth(both[torch.from_numpy(first)], seen, Transform.stack([f.world_from_agent for f in frames]))
