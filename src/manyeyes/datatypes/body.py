# SPDX-License-Identifier: Apache-2.0
"""The body that carries an agent's sensors: the box of its vehicle, in the agent's own frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes.boxes import Boxes
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.transform import Transform

MAX_OFFSET_M, MAX_SIZE_M = 20.0, 25.0
"""Maximum distance of a body's middle from the agent's origin along each axis, and maximum length, width and height."""


@dataclass(frozen=True)
class AgentBody:
    """Box of the agent's own vehicle in the agent's frame.

    center: x, y, z of its middle, metres; size: length, width, height, metres; yaw_rad: heading of the vehicle, 0 along the
    frame's x. Formats differ in where the frame lies: at the middle of the body, at its rear axle, or under the sensor.
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        values = (*self.center, *self.size, self.yaw_rad)
        if len(self.center) != 3 or len(self.size) != 3 or not all(map(math.isfinite, values)):
            raise ShapeError(f"AgentBody needs a finite center (x, y, z), size (l, w, h) and yaw_rad; got {self}.")
        if max(map(abs, self.center)) > MAX_OFFSET_M or not 0 < min(self.size) <= max(self.size) <= MAX_SIZE_M:
            raise ShapeError(
                f"AgentBody needs its center within {MAX_OFFSET_M:g} m of the origin and sizes up to {MAX_SIZE_M:g} m; got {self}."
            )

    @classmethod
    def standing(cls, x: float, y: float, size: tuple[float, float, float], yaw_rad: float = 0.0) -> AgentBody:
        """Return a body that stands on z = 0, with its middle above (x, y)."""
        return cls((x, y, size[2] / 2), size, yaw_rad)

    def boxes(self, dtype: torch.dtype = torch.float32) -> Boxes:
        """Return the body as one box in the agent's frame."""
        center, size = (torch.tensor([list(value)], dtype=dtype) for value in (self.center, self.size))
        return Boxes.of(center, size, torch.tensor([self.yaw_rad], dtype=dtype))

    def contains(self, points: Tensor, margin_m: float = 0.0) -> Tensor:
        """Return (N,) bool: which points (N, 3) of the agent's frame lie in the body, enlarged by margin_m on every side."""
        return self.boxes(points.dtype).contains(points, margin_m)[0]

    def contains_xy(self, xy: Tensor, margin_m: float = 0.0) -> Tensor:
        """Return (N,) bool: which places (N, 2) of the agent's frame lie above or below the body, enlarged by margin_m."""
        height = torch.full((len(xy), 1), self.center[2], dtype=xy.dtype)
        return self.contains(torch.cat((xy, height), 1), margin_m)

    def moved(self, new_from_agent: Transform) -> AgentBody:
        """Return the body in a new frame of the agent."""
        box = self.boxes(torch.float64).transform(new_from_agent.double())
        x, y, z = box.center[0].tolist()
        return replace(self, center=(x, y, z), yaw_rad=float(box.yaw[0]))
