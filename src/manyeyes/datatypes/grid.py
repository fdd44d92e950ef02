# SPDX-License-Identifier: Apache-2.0
"""The bird's-eye grid: metres to cells and back, at any stride, by one pair of functions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from manyeyes.datatypes.errors import ConfigError

MAX_SIDE_CELLS = 2**16
"""Maximum number of pillars along a side of a grid."""


@dataclass(frozen=True)
class BevGrid:
    """A lattice of square pillars over the ground around an agent, seen at a stride.

    x_min … z_max: metres in the agent's frame; pillar: edge of a cell at stride 1, metres. At stride s cell o is
    centred on pillar s*o (the centre of a strided 3x3 convolution with padding 1), so its metric centre is
    ``x_min + (s*o + 0.5) * pillar`` and *not* ``x_min + (o + 0.5) * s * pillar``: at stride 8 these are 1.4 m apart.
    """

    x_min: float
    y_min: float
    z_min: float
    x_max: float
    y_max: float
    z_max: float
    pillar: float = 0.4
    stride: int = 1

    def __post_init__(self) -> None:
        if not (self.x_max > self.x_min and self.y_max > self.y_min and self.z_max > self.z_min and self.pillar > 0):
            raise ConfigError(f"BevGrid needs max > min on every axis and pillar > 0; got {self}.")
        rows, columns = (self.y_max - self.y_min) / self.pillar, (self.x_max - self.x_min) / self.pillar
        if not max(rows, columns) <= MAX_SIDE_CELLS:
            raise ConfigError(
                f"BevGrid has at most {MAX_SIDE_CELLS:,} pillars a side; got {self}: take a larger pillar."
            )
        if self.stride not in (1, 2, 4, 8, 16, 32):
            raise ConfigError(f"BevGrid.stride is one of 1, 2, 4, 8, 16, 32; got {self.stride}.")

    @cached_property
    def shape(self) -> tuple[int, int]:
        """(rows along y, columns along x) at this stride."""
        rows, columns = round((self.y_max - self.y_min) / self.pillar), round((self.x_max - self.x_min) / self.pillar)
        return -(-rows // self.stride), -(-columns // self.stride)

    @property
    def cell_size_m(self) -> float:
        """Edge of a cell at this stride, metres."""
        return self.stride * self.pillar

    def at(self, stride: int) -> BevGrid:
        """Return the same ground at another stride."""
        return replace(self, stride=stride)

    def centers(self, yx: Tensor) -> Tensor:
        """Metric centres (N, 2) as x, y of cells (N, 2) given as row, column. The inverse of :meth:`cells`."""
        origin = torch.tensor([self.x_min, self.y_min], dtype=torch.float64, device=yx.device)
        return (origin + (yx.flip(-1).double() * self.stride + 0.5) * self.pillar).float()

    def cells(self, xy: Tensor) -> Tensor:
        """Return row and column (N, 2) of the nearest cell centre of points (N, 2); clamped to the grid. See :meth:`contains`."""
        origin = torch.tensor([self.x_min, self.y_min], dtype=torch.float64, device=xy.device)
        nearest = (((xy.double() - origin) / self.pillar - 0.5) / self.stride + 0.5).floor().long().flip(-1)
        return torch.minimum(nearest.clamp_min(0), nearest.new_tensor(self.shape) - 1)

    def contains(self, points: Tensor) -> Tensor:
        """Return (N,) bool: which points (N, 2 or 3) lie within the range; half-open, [min, max)."""
        axes = points.shape[-1]
        low = points.new_tensor([self.x_min, self.y_min, self.z_min][:axes])
        high = points.new_tensor([self.x_max, self.y_max, self.z_max][:axes])
        return ((points >= low) & (points < high)).all(-1)
