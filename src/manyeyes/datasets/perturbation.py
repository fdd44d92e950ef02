# SPDX-License-Identifier: Apache-2.0
"""Disturbances of a recording: errors of prior poses, and the literature's whole-frame staleness.

Ground truth and point clouds stay as they are: clouds are in the frame of their agent, whose prior pose alone is wrong.
Transport delay and loss are not here; they follow from the bytes sent, in ``comms/channel``.

To disturb in both ways, apply the noise to every snapshot first, then the staleness: a stale message carries the noisy
pose of the instant at which it was captured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import AgentFrame, ConfigError, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_normal

NoiseMode = Literal["collaborators_iid", "all_agents_iid", "all_agents_sequence", "legacy_constant"]


@dataclass(frozen=True)
class PoseNoise:
    """Errors of prior poses: sigma_xy_m (metres, each axis of the world) and sigma_yaw_rad (radians), Gaussian.

    mode: ``collaborators_iid`` (the default of this project) moves every agent but the ego, again in each frame;
    ``all_agents_iid`` (CoAlign) moves the ego too, so that relative errors are sqrt(2) larger;
    ``all_agents_sequence`` (SparseAlign) moves all, by one error an agent for the whole scenario;
    ``legacy_constant`` (OpenCOOD) moves every agent but the ego by one and the same offset in x, y, z and yaw in all
    frames, because that code seeds the generator again in each call. A network can learn that offset, so its curves
    measure no robustness; it is here for parity.

    The first three draw three standard normals keyed by (seed, scenario, frame, agent), the frame being 0 for a
    sequence, and scale them: the same unit draw at every level, so that curves over levels are paired, and
    ``collaborators_iid`` and ``all_agents_iid`` agree on the collaborators.
    """

    mode: NoiseMode = "collaborators_iid"
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.mode not in get_args(NoiseMode):
            raise ConfigError(f"No pose noise is called {self.mode!r}; known: {', '.join(get_args(NoiseMode))}.")
        if not (0 <= self.sigma_xy_m < math.inf and 0 <= self.sigma_yaw_rad < math.inf):
            raise ConfigError(
                f"PoseNoise needs finite sigmas >= 0; got {self.sigma_xy_m} m and {self.sigma_yaw_rad} rad."
            )

    def apply(self, snapshot: Snapshot, ego: int) -> Snapshot:
        """Return the snapshot with prior poses displaced, their covariance grown by the noise; truth as it was."""
        everyone = self.mode.startswith("all_agents")
        frames = tuple(
            self._displace(frame, self.offset(snapshot.scenario, snapshot.index, frame.agent_id))
            if everyone or row != ego
            else frame
            for row, frame in enumerate(snapshot.frames)
        )
        return replace(snapshot, frames=frames)

    def offset(self, scenario: str, index: int, agent_id: int) -> Tensor:
        """Draw the error x, y, z (m) and yaw (rad) of an agent's prior pose in the world, (4,) float64."""
        if self.mode == "legacy_constant":
            x, y, z, yaw = opencood_offset(self.seed, self.sigma_xy_m, self.sigma_yaw_rad)
            # The draw is in CARLA's left-handed world: our y axis and our sense of turning are its opposites.
            return torch.tensor([x, -y, z, -yaw], dtype=torch.float64)
        frame = 0 if self.mode == "all_agents_sequence" else index
        x, y, yaw = keyed_normal((3,), self.seed, "pose noise", scenario, frame, agent_id)
        return torch.stack((self.sigma_xy_m * x, self.sigma_xy_m * y, torch.zeros_like(x), self.sigma_yaw_rad * yaw))

    def _displace(self, frame: AgentFrame, offset: Tensor) -> AgentFrame:
        turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(offset[3])).rotation
        pose = frame.world_from_agent
        variance = torch.tensor([self.sigma_xy_m, self.sigma_xy_m, self.sigma_yaw_rad], dtype=torch.float64).square()
        return replace(
            frame,
            world_from_agent=Transform(turn.to(pose.rotation.dtype) @ pose.rotation, pose.translation + offset[:3]),
            odometry=frame.odometry or pose,
            pose_covariance=frame.pose_covariance + variance.diag().to(frame.pose_covariance.dtype),
        )


def opencood_offset(seed: int, sigma_xyz: float, sigma_angle: float) -> tuple[float, float, float, float]:
    """Compute x, y, z and yaw of OpenCOOD's re-seeded draw, in CARLA's axes; the angle in the unit of its sigma.

    Three normals for the position, then three for angles of which the second is used, from NumPy's legacy generator.
    """
    generator = np.random.RandomState(seed)
    x, y, z = generator.normal(0.0, sigma_xyz, 3)
    return float(x), float(y), float(z), float(generator.normal(0.0, sigma_angle, 3)[1])


@dataclass(frozen=True)
class FrameDelay:
    """Messages of collaborators are a whole number of frames old (OpenCOOD's ``sim`` delay: one per 100 ms).

    Its cloud, pose and time stamp are those of the earlier frame; the ego and the truth are current; the motion of
    objects since then is not removed. The age is clipped at the start of the scenario, or of the agent's presence in it.
    """

    frames: int

    def __post_init__(self) -> None:
        if self.frames < 0:
            raise ConfigError(f"FrameDelay counts frames back in time, at least 0; got {self.frames}.")

    def apply(self, snapshot: Snapshot, ego: int, history: Sequence[Snapshot]) -> Snapshot:
        """Return the snapshot with its collaborators stale. history: the scenario's previous snapshots, oldest first."""
        begin = max(0, len(history) - self.frames)
        # A lazy sequence is read only where it is needed, oldest wanted frame first.
        candidates = (history[k] if k < len(history) else snapshot for k in range(begin, len(history) + 1))
        collaborator_ids = {frame.agent_id for row, frame in enumerate(snapshot.frames) if row != ego}
        stale: dict[int, AgentFrame] = {}
        for moment in candidates if self.frames else ():
            stale |= {
                f.agent_id: f for f in moment.frames if f.agent_id in collaborator_ids and f.agent_id not in stale
            }
            if len(stale) == len(collaborator_ids):
                break
        frames = tuple(f if row == ego else stale.get(f.agent_id, f) for row, f in enumerate(snapshot.frames))
        return replace(snapshot, frames=frames)
