# SPDX-License-Identifier: Apache-2.0
"""One instant of a drive: the frames of all agents and, separately, the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes.body import AgentBody
from manyeyes.datatypes.boxes import VEHICLES, Boxes
from manyeyes.datatypes.camera import CameraImage
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.numbers import Numbers, as_tensor
from manyeyes.datatypes.point_cloud import PointCloud
from manyeyes.datatypes.transform import Transform


@dataclass(frozen=True)
class AgentFrame:
    """One agent at one instant: all inputs of its perception, without labels.

    points: in the agent's own frame (x forward, y left, z up; z = 0 is the road under it, under a pole too).
    world_from_agent: the *prior* pose; pose_covariance: (3, 3) of x, y (m) and yaw (rad) in the world, the
    agent's estimate of its error. sensor_height_m: height of the LiDAR above the road. speed_mps: own speed. odometry:
    the pose in a local frame that drifts but never jumps, for motion since earlier frames; by default the prior pose.
    images: of its cameras, if it has any and they were requested. body: of its vehicle, in its frame; None is unknown, and of
    infrastructure.
    """

    agent_id: int
    timestamp_ns: int
    points: PointCloud
    world_from_agent: Transform
    pose_covariance: Tensor
    sensor_height_m: float = 1.9
    speed_mps: float = 0.0
    is_infrastructure: bool = False
    odometry: Transform | None = None
    images: tuple[CameraImage, ...] = ()
    body: AgentBody | None = None

    def __post_init__(self) -> None:
        if self.pose_covariance.shape != (3, 3):
            raise ShapeError(f"AgentFrame.pose_covariance needs (3, 3); got {tuple(self.pose_covariance.shape)}.")
        # World coordinates reach kilometres, where float32 is off by millimetres; all later products are of float64.
        object.__setattr__(self, "world_from_agent", self.world_from_agent.double())
        if self.odometry is not None:
            object.__setattr__(self, "odometry", self.odometry.double())

    @classmethod
    def of(
        cls,
        points: PointCloud | Numbers,
        world_from_agent: Transform | Numbers,
        agent_id: int = 0,
        timestamp_ns: int = 0,
        pose_covariance: Numbers | None = None,
        sensor_height_m: float = 1.9,
        speed_mps: float = 0.0,
        body: AgentBody | None = None,
    ) -> AgentFrame:
        """Build a frame from a cloud or its points (N, 3), and a pose or its matrix (4, 4): tensors, numpy arrays or lists.

        Points become float32, poses and covariances float64; without a covariance it is zero.

        Raises:
            ShapeError: another shape, NaN or infinite values, or a matrix that is not a rigid motion.
        """
        covariance = torch.zeros(3, 3) if pose_covariance is None else pose_covariance
        return cls(
            agent_id,
            timestamp_ns,
            points if isinstance(points, PointCloud) else PointCloud.of(points),
            world_from_agent if isinstance(world_from_agent, Transform) else Transform.from_matrix(world_from_agent),
            as_tensor(covariance, "AgentFrame.pose_covariance", torch.float64),
            sensor_height_m,
            speed_mps,
            body=body,
        )

    def now_from_earlier(self, earlier: AgentFrame) -> Transform:
        """From the agent's own frame of an earlier instant to this one, by its odometry."""
        now, then = self.odometry or self.world_from_agent, earlier.odometry or earlier.world_from_agent
        return now.inverse() @ then

    def moved(self, new_from_agent: Transform) -> AgentFrame:
        """Return the same observation in a new frame of the agent: points, poses, cameras, body and the height of the LiDAR."""
        agent_from_new = new_from_agent.double().inverse()
        lidar = new_from_agent.apply(torch.tensor([[0.0, 0.0, self.sensor_height_m]], dtype=torch.float64))
        return replace(
            self,
            points=self.points.transform(new_from_agent),
            world_from_agent=self.world_from_agent @ agent_from_new,
            sensor_height_m=float(lidar[0, 2]),
            odometry=None if self.odometry is None else self.odometry @ agent_from_new,
            images=tuple(image.moved(new_from_agent) for image in self.images),
            body=None if self.body is None else self.body.moved(new_from_agent),
        )


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of one instant; used by evaluation and training only.

    boxes: in the world frame, float64, ids set. seen: (agents, N) bool, whether an agent lists the box (its LiDAR met
    it); row order is that of Snapshot.frames. world_from_agent: the true poses, batch shape (agents,).
    """

    boxes: Boxes
    seen: Tensor
    world_from_agent: Transform

    @classmethod
    def of(cls, boxes: Boxes, world_from_agent: Transform | Numbers, seen: Numbers | None = None) -> GroundTruth:
        """Build ground truth from poses or their matrices (agents, 4, 4): tensors, numpy arrays or lists.

        Without ``seen`` every agent lists every box. Boxes and poses become float64.

        Raises:
            ShapeError: a shape does not fit, or a matrix is not a rigid motion.
        """
        poses = world_from_agent if isinstance(world_from_agent, Transform) else Transform.from_matrix(world_from_agent)
        listed = torch.ones(*poses.translation.shape[:-1], len(boxes)) if seen is None else seen
        return cls(boxes.to(torch.float64), as_tensor(listed, "GroundTruth.seen", torch.bool), poses.double())

    def of_classes(self, classes: Sequence[str] = VEHICLES) -> GroundTruth:
        """Return the truth of the boxes of the listed classes alone."""
        rows = self.boxes.class_rows(classes) >= 0
        return self if bool(rows.all()) else GroundTruth(self.boxes[rows], self.seen[:, rows], self.world_from_agent)

    def __post_init__(self) -> None:
        agents = tuple(self.world_from_agent.translation.shape[:-1])
        if len(agents) != 1:
            raise ShapeError(f"GroundTruth.world_from_agent needs the batch shape (agents,); got {agents}.")
        if self.seen.shape != (*agents, len(self.boxes)):
            raise ShapeError(f"GroundTruth.seen needs ({agents[0]}, {len(self.boxes)}); got {tuple(self.seen.shape)}.")


@dataclass(frozen=True)
class Snapshot:
    """All agents at one instant. scenario and index name it in its recording."""

    scenario: str
    index: int
    frames: tuple[AgentFrame, ...]
    truth: GroundTruth | None = None
