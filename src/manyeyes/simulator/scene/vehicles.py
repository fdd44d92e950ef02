# SPDX-License-Identifier: Apache-2.0
"""What stands and drives on the roads at one instant."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ShapeError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VehicleStates:
    """N vehicles at one instant, world axes.

    id: (N,) int64. kind: (N,) int64, index into LABELS. position: (N, 3) metres, the middle of the footprint on the road (not
    the box's centre, which is half a height above). yaw: (N,) radians about +z, 0 along +x. pitch: (N,) radians as
    Transform.from_rpy takes it: right-handed about the left axis, so that uphill is negative. speed: (N,) m/s.
    size: (N, 3) length, width, height. roll: (N,) radians about the forward axis, positive where the left side is higher; zero
    when left out.
    """

    id: NDArray[np.int64]
    kind: NDArray[np.int64]
    position: Array
    yaw: Array
    pitch: Array
    speed: Array
    size: Array
    roll: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        n = len(self.id)
        if not len(self.roll):
            object.__setattr__(self, "roll", np.zeros(n))
        wanted = {"position": (n, 3), "size": (n, 3)}
        for column in fields(self):
            shape = getattr(self, column.name).shape
            if shape != wanted.get(column.name, (n,)):
                raise ShapeError(
                    f"VehicleStates.{column.name} needs shape {wanted.get(column.name, (n,))}; got {shape}."
                )

    @classmethod
    def empty(cls) -> VehicleStates:
        """Return a set without any vehicle."""
        whole, real, triple = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))
        return cls(whole, whole, triple, real, real, real, triple)

    @classmethod
    def cat(cls, many: list[VehicleStates]) -> VehicleStates:
        """Concatenate several sets into one."""
        return cls(*(np.concatenate([getattr(v, f.name) for v in many]) for f in fields(cls))) if many else cls.empty()

    def __len__(self) -> int:
        return len(self.id)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64] | slice) -> VehicleStates:
        return VehicleStates(*(getattr(self, f.name)[index] for f in fields(self)))

    def corners(self, margin_m: float = 0.0) -> Array:
        """Return (N, 4, 2) corners of the footprints, enlarged on every side: front left, front right, rear right, rear left."""
        unit = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
        local = unit * (self.size[:, None, :2] / 2 + margin_m)
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        turned = np.stack((local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c), -1)
        return turned + self.position[:, None, :2]


def overlaps(corners: Array, others: Array) -> NDArray[np.bool_]:
    """Return (N,) which of the rectangles others (N, 4, 2) touch the rectangle corners (4, 2); separating axes."""
    hit = np.ones(len(others), bool)
    both = np.concatenate((np.broadcast_to(corners, others.shape), others), 1)
    for a, b in ((0, 1), (1, 2), (4, 5), (5, 6)):
        axis = both[:, b] - both[:, a]
        one = np.einsum("nkd,nd->nk", both[:, :4], axis)
        two = np.einsum("nkd,nd->nk", both[:, 4:], axis)
        hit &= (one.max(1) >= two.min(1)) & (two.max(1) >= one.min(1))
    return hit
