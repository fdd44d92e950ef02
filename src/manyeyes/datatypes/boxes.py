# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes on the ground: detections and ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from manyeyes.datatypes.errors import ConfigError, ShapeError
from manyeyes.datatypes.numbers import Numbers, as_tensor
from manyeyes.datatypes.transform import Transform

VEHICLE_LABELS = ("car", "van", "truck", "bus")
LABELS = (*VEHICLE_LABELS, "pedestrian", "cyclist", "motorcyclist")
CLASSES = ("vehicle", "pedestrian", "cyclist")
"""What is detected and evaluated together: all of VEHICLE_LABELS; pedestrians; cyclists and motorcyclists."""
VEHICLES = ("vehicle",)
_CLASS_OF_LABEL = (0, 0, 0, 0, 1, 2, 2)


@dataclass(frozen=True)
class Boxes:
    """N boxes in one frame.

    center: (N, 3) metres, the middle of the box; size: (N, 3) length, width, height; yaw: (N,) radians about +z,
    0 along +x. score: (N,) in [0, 1]; label: (N,) int64, index into LABELS; id: (N,) int64, -1 when unknown.
    sigma_xy: (N,) metres, sigma_yaw: (N,) radians and p_flip: (N,) in [0, 1] are the detector's estimates of its
    error and of the probability that the heading is off by pi; zero for ground truth. velocity: (N, 2) m/s over the
    ground along the frame's x and y, zero where unknown.
    """

    center: Tensor
    size: Tensor
    yaw: Tensor
    score: Tensor
    label: Tensor
    id: Tensor
    sigma_xy: Tensor
    sigma_yaw: Tensor
    p_flip: Tensor
    velocity: Tensor

    def __post_init__(self) -> None:
        n = self.center.shape[0] if self.center.ndim else 0
        expected = {"center": (n, 3), "size": (n, 3), "velocity": (n, 2)}
        for name in _FIELDS:
            shape = getattr(self, name).shape
            if shape != expected.get(name, (n,)):
                raise ShapeError(f"Boxes.{name} needs shape {expected.get(name, (n,))}; got {tuple(shape)}.")

    @classmethod
    def of(
        cls,
        center: Numbers,
        size: Numbers,
        yaw: Numbers,
        score: Numbers | None = None,
        label: Numbers | None = None,
        id: Numbers | None = None,
        velocity: Numbers | None = None,
    ) -> Boxes:
        """Build boxes from tensors, numpy arrays or lists; the rest is score 1, label 0, id -1, velocity 0, no uncertainty.

        Shapes and units are those of the class. Tensors keep their type. Of other input, centers are float32 if they are an array
        of float32, else float64; labels and ids are int64; everything else is of the type of the centers.

        Raises:
            ShapeError: a shape does not fit the number of centers, or a value is not a number.
        """
        center = as_tensor(center, "Boxes.center", None)
        n = center.shape[0] if center.ndim else 0
        zeros, zero_ids = center.new_zeros(n), center.new_zeros(n, dtype=torch.int64)

        def column(name: str, value: Numbers | None, default: Tensor) -> Tensor:
            if value is None or isinstance(value, Tensor):
                return default if value is None else value
            return as_tensor(value, f"Boxes.{name}", default.dtype)

        return cls(
            center,
            column("size", size, zeros),
            column("yaw", yaw, zeros),
            column("score", score, zeros + 1),
            column("label", label, zero_ids),
            column("id", id, zero_ids - 1),
            zeros,
            zeros,
            zeros,
            column("velocity", velocity, center.new_zeros(n, 2)),
        )

    @classmethod
    def empty(cls, dtype: torch.dtype = torch.float32) -> Boxes:
        """Return an instance without boxes."""
        return cls.of(torch.zeros(0, 3, dtype=dtype), torch.zeros(0, 3, dtype=dtype), torch.zeros(0, dtype=dtype))

    def __len__(self) -> int:
        return self.center.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Boxes:
        if isinstance(index, Tensor) and index.dtype == torch.bool:
            index = index.nonzero()[:, 0]  # once instead of for each field
            return Boxes(*(getattr(self, name).index_select(0, index) for name in _FIELDS))
        return Boxes(*(getattr(self, name)[index] for name in _FIELDS))

    @classmethod
    def cat(cls, many: list[Boxes]) -> Boxes:
        """Return several sets of one frame as one."""
        return cls(*(torch.cat([getattr(b, name) for b in many]) for name in _FIELDS)) if many else cls.empty()

    def to(self, dtype: torch.dtype | None = None, device: torch.device | None = None) -> Boxes:
        """Return the same boxes in another floating-point type, or on another device, or both."""
        values = [getattr(self, name) for name in _FIELDS]
        if device is None and all(dtype is None or v.dtype == dtype or not v.is_floating_point() for v in values):
            return self
        return Boxes(*(v.to(device=device, dtype=dtype if v.is_floating_point() else None) for v in values))

    def transform(self, target_from_source: Transform) -> Boxes:
        """Return the same boxes in another frame; headings and velocities are projected onto the target's ground plane."""
        turn = target_from_source.rotation.to(self.yaw.dtype).mT
        ahead = torch.stack((self.yaw.cos(), self.yaw.sin(), torch.zeros_like(self.yaw)), -1) @ turn
        velocity = (self.velocity.to(turn.dtype) @ turn[:2])[:, :2]
        values = {name: getattr(self, name) for name in _FIELDS}
        values |= {"center": target_from_source.apply(self.center), "yaw": torch.atan2(ahead[:, 1], ahead[:, 0])}
        return Boxes(**(values | {"velocity": velocity}))

    def class_rows(self, classes: Sequence[str] = VEHICLES) -> Tensor:
        """Return (N,) int64: the position of each box's class in the list, -1 where it is of no listed class.

        Raises:
            ConfigError: a name is none of CLASSES.
        """
        unknown = [name for name in classes if name not in CLASSES]
        if unknown:
            raise ConfigError(f"No class of objects is called {unknown[0]!r}; known: {', '.join(CLASSES)}.")
        row = [classes.index(CLASSES[kind]) if CLASSES[kind] in classes else -1 for kind in _CLASS_OF_LABEL]
        return torch.tensor(row, device=self.label.device)[self.label]

    def of_classes(self, classes: Sequence[str] = VEHICLES) -> Boxes:
        """Return the boxes of the listed classes."""
        return self[self.class_rows(classes) >= 0]

    def after(self, seconds: float) -> Boxes:
        """Where the boxes are so much later, if each keeps its velocity."""
        center = self.center.clone()
        center[:, :2] += self.velocity * seconds
        return replace(self, center=center)

    def bev(self) -> Tensor:
        """Return (N, 5): x, y, length, width, yaw."""
        return torch.cat((self.center[:, :2], self.size[:, :2], self.yaw[:, None]), -1)

    def corners(self) -> Tensor:
        """Return (N, 8, 3): front left, front right, rear right, rear left at the bottom, then the same at the top."""
        unit = torch.tensor(
            [[x, y, z] for z in (-0.5, 0.5) for x, y in ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))],
            dtype=self.center.dtype,
            device=self.center.device,
        )
        local = unit * self.size[:, None, :]
        c, s = self.yaw.cos()[:, None], self.yaw.sin()[:, None]
        x, y = local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c
        return torch.stack((x, y, local[..., 2]), -1) + self.center[:, None, :]

    def contains(self, points: Numbers, margin_m: float = 0.0) -> Tensor:
        """Return (N, P) bool: which of the points (P, 3) lie in each box, enlarged by margin_m on every side."""
        delta = as_tensor(points, "Boxes.contains", None)[None] - self.center[:, None]
        c, s = self.yaw.cos()[:, None], self.yaw.sin()[:, None]
        local = torch.stack(
            (delta[..., 0] * c + delta[..., 1] * s, delta[..., 1] * c - delta[..., 0] * s, delta[..., 2]), -1
        )
        return (local.abs() <= self.size[:, None] / 2 + margin_m).all(-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap angles to [-pi, pi), radians."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


_FIELDS = tuple(field.name for field in fields(Boxes))
