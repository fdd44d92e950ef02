# SPDX-License-Identifier: Apache-2.0
"""What stands and drives on the roads at one instant, and how large such vehicles are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import VEHICLE_LABELS, ShapeError

Array = NDArray[np.float64]

KIND_FRACTIONS = (0.78, 0.10, 0.07, 0.05)
# Low and high of length, width, height in metres, by LABELS: what drives in European cities.
_SIZE_RANGES = np.array(
    [
        [[3.6, 5.1], [1.7, 2.0], [1.35, 1.8]],
        [[5.2, 6.0], [1.95, 2.05], [2.0, 2.6]],
        [[6.5, 10.0], [2.3, 2.55], [2.8, 3.6]],
        [[10.0, 12.5], [2.5, 2.55], [3.0, 3.3]],
    ]
)


@dataclass(frozen=True, eq=False)
class VehicleStates:
    """N vehicles at one instant, world axes.

    id: (N,) int64. kind: (N,) int64, index into LABELS. position: (N, 3) metres, the middle of the footprint on the road (not
    the box's centre, which is half a height above). yaw: (N,) radians about +z, 0 along +x. pitch: (N,) radians as
    Transform.from_rpy takes it: right-handed about the left axis, so that uphill is negative. speed: (N,) m/s.
    size: (N, 3) length, width, height.
    """

    id: NDArray[np.int64]
    kind: NDArray[np.int64]
    position: Array
    yaw: Array
    pitch: Array
    speed: Array
    size: Array

    def __post_init__(self) -> None:
        n = len(self.id)
        wanted = {"position": (n, 3), "size": (n, 3)}
        for field in fields(self):
            shape = getattr(self, field.name).shape
            if shape != wanted.get(field.name, (n,)):
                raise ShapeError(f"VehicleStates.{field.name} needs shape {wanted.get(field.name, (n,))}; got {shape}.")

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


def draw_vehicles(
    random: np.random.Generator, count: int, kind_fractions: tuple[float, ...] = KIND_FRACTIONS
) -> tuple[NDArray[np.int64], Array]:
    """Return kinds (N,) by shares over LABELS, and sizes (N, 3); long cars tend to be wide ones."""
    kind = random.choice(len(VEHICLE_LABELS), count, p=kind_fractions).astype(np.int64)
    unit = random.random((count, 3))
    unit[:, 1] = (unit[:, 0] + unit[:, 1]) / 2
    low, high = _SIZE_RANGES[kind, :, 0], _SIZE_RANGES[kind, :, 1]
    return kind, low + unit * (high - low)


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
