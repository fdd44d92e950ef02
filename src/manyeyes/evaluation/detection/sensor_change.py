# SPDX-License-Identifier: Apache-2.0
"""Changes of the sensors of a recording in an evaluation: intensity law, number of sweeps, tilt; geometry stays as recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch

from manyeyes.datatypes import AgentFrame, ConfigError, PointCloud, Snapshot, Transform
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.ops.lidar.intensity import INTENSITY_LAWS, change_intensity_law


@dataclass(frozen=True)
class SensorChange:
    """What is changed for all agents alike.

    Attributes:
        law: name in INTENSITY_LAWS of the law of a recording with material intensity; None for its own.
        sweeps: 1: detectors are given no earlier sweep (:func:`manyeyes.models.detector.single_sweep.with_single_sweep`).
        tilt_deg: tilt of every agent's sensor about a horizontal axis that is drawn for each agent of a scenario, degrees.
        seed: of the draws.

    Raises:
        ConfigError: there is no such law, or the tilt is negative or beyond 45 degrees.
    """

    law: str | None = None
    sweeps: Literal[1, 2] = 2
    tilt_deg: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.law is not None and self.law not in INTENSITY_LAWS:
            raise ConfigError(f"No intensity law {self.law!r}; choose one of {', '.join(INTENSITY_LAWS)}.")
        if not 0 <= self.tilt_deg <= 45:
            raise ConfigError(f"SensorChange.tilt_deg needs a number from 0 to 45; got {self.tilt_deg}.")

    def apply(self, snapshot: Snapshot) -> Snapshot:
        """Return the snapshot as the changed sensors measure it; poses and truth stay."""
        if self.law is None and not self.tilt_deg:
            return snapshot
        frames = tuple(replace(frame, points=self._change(frame, snapshot.scenario)) for frame in snapshot.frames)
        return replace(snapshot, frames=frames)

    def _change(self, frame: AgentFrame, scenario: str) -> PointCloud:
        points, key = frame.points, (self.seed, scenario, frame.agent_id)
        if self.law is not None:
            law = INTENSITY_LAWS[self.law]
            is_per_return = law.kind in ("noise", "shuffled")
            law_key = (*key, frame.timestamp_ns) if is_per_return else key
            points = change_intensity_law(points, law, frame.sensor_height_m, law_key)
        if not self.tilt_deg:
            return points
        tilt = _make_tilt(math.radians(self.tilt_deg), 2 * math.pi * float(keyed_uniform((1,), "tilt", *key)[0]))
        origin = torch.tensor([0.0, 0.0, frame.sensor_height_m], dtype=torch.float64)
        return points.transform(Transform(tilt, origin - tilt @ origin))


def _make_tilt(angle_rad: float, axis_yaw_rad: float) -> torch.Tensor:
    """Return the rotation (3, 3) float64 about a horizontal axis (Rodrigues)."""
    x, y = math.cos(axis_yaw_rad), math.sin(axis_yaw_rad)
    cross = torch.tensor([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * cross @ cross


NO_SENSOR_CHANGE = SensorChange()
