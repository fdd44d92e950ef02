# SPDX-License-Identifier: Apache-2.0
"""Returns as through glass and in rain, made of simulated ones: what rays pass through, or end in, that is no object.

Both are simple models of the effect on evidence by rays, not of optics. Glass: of the returns in the band of windows of vehicles
some are lost and some come from behind, so that rays seem to cross an object. Rain: returns are lost with the distance, by an
extinction on both ways, and some come from drops near the sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, Snapshot
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.studies.attacks._weather_kernels import find_window_returns

WINDOW_MARGIN_M = 0.1
"""Maximum distance of a return of a window from its vehicle."""


@dataclass(frozen=True)
class GlassReturns:
    """window_band: of the height of a vehicle. lost, behind: fractions of the returns there that are lost, and that come from up to
    max_behind_m behind.
    """

    window_band: tuple[float, float] = (0.55, 0.9)
    lost: float = 0.3
    behind: float = 0.4
    max_behind_m: float = 15.0

    def apply(self, frame: AgentFrame, objects: Boxes, unit: Tensor) -> PointCloud:
        """Return the changed cloud; objects (N) in the frame's axes, unit (P, 3) uniform."""
        points = frame.points
        boxes = torch.cat((objects.center, objects.size, objects.yaw[:, None]), 1).double().numpy()
        xyz = np.ascontiguousarray(points.xyz.float().numpy())
        in_window = torch.from_numpy(find_window_returns(xyz, boxes, *self.window_band, WINDOW_MARGIN_M))
        passes = in_window & (unit[:, 0] >= self.lost) & (unit[:, 0] < self.lost + self.behind)
        extra_m = torch.where(passes, self.max_behind_m * unit[:, 1].float(), 0.0)
        moved = _extend(points.xyz, frame.sensor_height_m, extra_m)
        kept = ~(in_window & (unit[:, 0] < self.lost))
        return replace(points, xyz=moved)[kept]


@dataclass(frozen=True)
class RainReturns:
    """extinction_per_m: of the intensity on one way. backscatter: fraction of rays that end in a drop within max_drop_m."""

    extinction_per_m: float = 0.005
    backscatter: float = 0.005
    max_drop_m: float = 8.0

    def apply(self, frame: AgentFrame, objects: Boxes, unit: Tensor) -> PointCloud:
        """Return the changed cloud; unit (P, 3) uniform."""
        points, sensor = frame.points, torch.tensor([0.0, 0.0, frame.sensor_height_m])
        range_m = (points.xyz - sensor).norm(dim=1)
        kept = unit[:, 0] < torch.exp(-2 * self.extinction_per_m * range_m)
        in_drop = unit[:, 1] < self.backscatter
        drop_m = torch.minimum(range_m, 1.0 + (self.max_drop_m - 1.0) * unit[:, 2].float())
        moved = _extend(points.xyz, frame.sensor_height_m, torch.where(in_drop, drop_m - range_m, 0.0))
        return replace(points, xyz=moved)[kept | in_drop]


VARIANTS: dict[str, GlassReturns | RainReturns | None] = {"clean": None, "glass": GlassReturns(), "rain": RainReturns()}


def make_weather(name: str, seed: int) -> Callable[[Snapshot], Snapshot]:
    """Return what changes the clouds of all agents of a snapshot, by a name of VARIANTS."""
    variant = VARIANTS[name]

    def change(snapshot: Snapshot) -> Snapshot:
        if variant is None:
            return snapshot
        truth, frames = snapshot.truth, list[AgentFrame]()
        for row, frame in enumerate(snapshot.frames):
            objects = Boxes.empty()
            if truth is not None:
                objects = truth.boxes.transform(truth.world_from_agent[row].inverse())
            key = "returns", name, snapshot.scenario, snapshot.index, frame.agent_id
            unit = keyed_uniform((len(frame.points), 3), seed, *key)
            frames.append(replace(frame, points=variant.apply(frame, objects, unit)))
        return replace(snapshot, frames=tuple(frames))

    return change


def _extend(xyz: Tensor, height_m: float, extra_m: Tensor) -> Tensor:
    """Return points (P, 3) farther along their rays by extra_m (P,)."""
    sensor = xyz.new_tensor([0.0, 0.0, height_m])
    ray = xyz - sensor
    range_m = ray.norm(dim=1).clamp_min(1e-6)
    return torch.where(extra_m[:, None] != 0, sensor + ray * (1 + extra_m / range_m)[:, None], xyz)
