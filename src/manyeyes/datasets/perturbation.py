# SPDX-License-Identifier: Apache-2.0
"""Disturbances of a recording: errors of prior poses, and the literature's whole-frame staleness.

Ground truth and point clouds stay as they are: clouds are in the frame of their agent, whose prior pose alone is wrong.
Transport delay and loss are not here; they follow from the bytes sent, in ``comms/channel``.

What an agent knows of its own motion is odometry, which drifts by itself (``datasets.odometry_drift``).
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
from manyeyes.ops.keyed_autoregressive import keyed_autoregressive
from manyeyes.ops.keyed_random import keyed_normal

NoiseMode = Literal["collaborators", "all_agents", "legacy_constant"]
NoiseInTime = Literal["autoregressive", "constant", "independent"]
CovarianceClaim = Literal["none", "half", "true", "double"]
CLAIM_FACTORS: dict[CovarianceClaim, float] = {"none": 0.0, "half": 0.5, "true": 1.0, "double": 2.0}
"""Claimed standard deviation over the true one."""
CORRELATION_TIME_S = 10.0
"""Correlation time of autoregressive noise: errors of satellite positioning in a street last for seconds to minutes."""


@dataclass(frozen=True)
class PoseNoise:
    """Errors of prior poses: sigma_xy_m (metres, each axis of the world) and sigma_yaw_rad (radians), Gaussian.

    mode: ``collaborators`` moves every agent but the ego; ``all_agents`` (CoAlign, SparseAlign) moves the ego too, so that
    relative errors are sqrt(2) larger; ``legacy_constant`` (OpenCOOD) moves every agent but the ego by one and the same offset in
    x, y, z and yaw in all frames, because that code seeds the generator again in each call. A network can learn that offset, so
    its curves measure no robustness; it is here for parity.

    in_time: how the error of an agent goes on, with the same variance at every instant: ``autoregressive`` is of first order,
    autocorrelation exp(-|lag| / correlation_time_s) (``ops.keyed_autoregressive``); ``constant`` is one error for a scenario
    (SparseAlign); ``independent`` is drawn again in each frame (CoAlign), which methods with memory average out.

    claim: standard deviation that agents add to their pose covariance, as a factor of the true one (CLAIM_FACTORS): the
    covariance weighs the fusion, and real agents seldom have it.

    The three standard normals of an agent follow from (seed, scenario, agent) and its time (``autoregressive``) or its frame
    (``independent``), whichever agents are present, and are scaled: the same unit draw at every level, so that curves over levels
    are paired, and both modes agree on the collaborators.
    """

    mode: NoiseMode = "collaborators"
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0
    seed: int = 0
    in_time: NoiseInTime = "autoregressive"
    claim: CovarianceClaim = "none"
    correlation_time_s: float = CORRELATION_TIME_S

    def __post_init__(self) -> None:
        for value, known in ((self.mode, NoiseMode), (self.in_time, NoiseInTime), (self.claim, CovarianceClaim)):
            if value not in get_args(known):
                raise ConfigError(f"PoseNoise knows no {value!r}; choose from {', '.join(get_args(known))}.")
        if not (0 <= self.sigma_xy_m < math.inf and 0 <= self.sigma_yaw_rad < math.inf):
            raise ConfigError(
                f"PoseNoise needs finite sigmas >= 0; got {self.sigma_xy_m} m and {self.sigma_yaw_rad} rad."
            )
        if not 0 < self.correlation_time_s < math.inf:
            raise ConfigError(f"PoseNoise.correlation_time_s is finite and above 0; got {self.correlation_time_s}.")

    @property
    def description(self) -> str:
        """The kind of error without its level, for notes under tables."""
        kinds = {
            "autoregressive": f"autoregressive in time (correlation time {self.correlation_time_s:g} s)",
            "constant": "constant through a scenario",
            "independent": "independent in each frame",
        }
        kind = "OpenCOOD's constant offset" if self.mode == "legacy_constant" else kinds[self.in_time]
        return f"{kind}; claimed covariance: {self.claim}"

    def at_level(self, sigma_xy_m: float, sigma_yaw_rad: float) -> PoseNoise | None:
        """Return the same kind of error at another level; None if nothing is displaced."""
        scaled = replace(self, sigma_xy_m=sigma_xy_m, sigma_yaw_rad=sigma_yaw_rad)
        return scaled if sigma_xy_m or sigma_yaw_rad else None

    def apply(self, snapshot: Snapshot, ego: int) -> Snapshot:
        """Return the snapshot with prior poses displaced and their covariance grown by the claim; truth as it was."""
        frames = tuple(
            self._displace(frame, self.offset(snapshot.scenario, snapshot.index, frame.agent_id, frame.timestamp_ns))
            if self.mode == "all_agents" or row != ego
            else frame
            for row, frame in enumerate(snapshot.frames)
        )
        return replace(snapshot, frames=frames)

    def offset(self, scenario: str, index: int, agent_id: int, timestamp_ns: int) -> Tensor:
        """Draw the error x, y, z (m) and yaw (rad) of an agent's prior pose in the world, (4,) float64."""
        if self.mode == "legacy_constant":
            x, y, z, yaw = opencood_offset(self.seed, self.sigma_xy_m, self.sigma_yaw_rad)
            # The draw is in CARLA's left-handed world: our y axis and our sense of turning are its opposites.
            return torch.tensor([x, -y, z, -yaw], dtype=torch.float64)
        if self.in_time == "autoregressive":
            key = (self.seed, "pose noise in time", scenario, agent_id)
            x, y, yaw = keyed_autoregressive(3, timestamp_ns, self.correlation_time_s, *key)
        else:
            frame = 0 if self.in_time == "constant" else index
            x, y, yaw = keyed_normal((3,), self.seed, "pose noise", scenario, frame, agent_id)
        return torch.stack((self.sigma_xy_m * x, self.sigma_xy_m * y, torch.zeros_like(x), self.sigma_yaw_rad * yaw))

    def _displace(self, frame: AgentFrame, offset: Tensor) -> AgentFrame:
        turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(offset[3])).rotation
        pose = frame.world_from_agent
        sigma = torch.tensor([self.sigma_xy_m, self.sigma_xy_m, self.sigma_yaw_rad], dtype=torch.float64)
        variance = (CLAIM_FACTORS[self.claim] * sigma).square()
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
