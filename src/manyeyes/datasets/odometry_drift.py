# SPDX-License-Identifier: Apache-2.0
"""Drift of odometry: what relates an agent's own past sweeps to the present one is measured, not true.

In each frame, the measured motion since the frame before is the true one followed by a small error in the agent's axes: x, y and
yaw of a random walk, whose variance grows with time. So the error of a motion over some frames depends on these frames alone, and
the pose in the odometry's frame drifts without a jump. Errors are keyed by (seed, scenario, agent, time).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from manyeyes.datatypes import AgentFrame, ConfigError, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_normal


@dataclass(frozen=True)
class OdometryDrift:
    """Size of the random walk: standard deviations after one second; they grow with the square root of time.

    The defaults are plausible round figures for wheels with an inertial sensor, not measurements: 6 mm and 0.006 degrees between
    two sweeps at 10 Hz. sigma_xy_m: metres, each axis of the agent; sigma_yaw_rad: radians.
    """

    sigma_xy_m: float = 0.02
    sigma_yaw_rad: float = math.radians(0.02)
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.sigma_xy_m < math.inf and 0 <= self.sigma_yaw_rad < math.inf):
            raise ConfigError(
                f"OdometryDrift needs finite sigmas >= 0; got {self.sigma_xy_m} m and {self.sigma_yaw_rad} rad."
            )

    @property
    def description(self) -> str:
        """The drift in words, for notes under tables."""
        return f"random walk of {self.sigma_xy_m:g} m and {math.degrees(self.sigma_yaw_rad):g}° per square root of a second"

    def error(self, scenario: str, agent_id: int, timestamp_ns: int, seconds: float) -> Transform:
        """Draw the error of the motion that ends at a time and took so many seconds."""
        x, y, yaw = keyed_normal((3,), self.seed, "odometry drift", scenario, agent_id, timestamp_ns).tolist()
        scale = math.sqrt(seconds)
        return Transform.from_xyz_yaw(
            scale * self.sigma_xy_m * x, scale * self.sigma_xy_m * y, 0.0, scale * self.sigma_yaw_rad * yaw
        )


class DriftingOdometry:
    """Odometry of all agents of one scenario, snapshot by snapshot."""

    def __init__(self, drift: OdometryDrift) -> None:
        self.drift = drift
        self._last: dict[int, tuple[AgentFrame, Transform]] = {}

    def apply(self, snapshot: Snapshot) -> Snapshot:
        """Return the next snapshot with drifting odometry; clouds, prior poses and truth as they were.

        It begins at the true odometry where an agent appears, or its time does not increase.
        """
        frames = tuple(self._measure(snapshot.scenario, frame) for frame in snapshot.frames)
        return replace(snapshot, frames=frames)

    def _measure(self, scenario: str, frame: AgentFrame) -> AgentFrame:
        before, measured = self._last.get(frame.agent_id, (frame, frame.odometry or frame.world_from_agent))
        seconds = (frame.timestamp_ns - before.timestamp_ns) / 1e9
        if seconds > 0:
            error = self.drift.error(scenario, frame.agent_id, frame.timestamp_ns, seconds)
            measured = measured @ frame.now_from_earlier(before).inverse() @ error
        elif seconds < 0:
            measured = frame.odometry or frame.world_from_agent
        self._last[frame.agent_id] = frame, measured
        return replace(frame, odometry=measured)
