# SPDX-License-Identifier: Apache-2.0
"""Landmarks: what an agent's decoded boxes say that another agent can recognise; no identity and no truth is in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import Boxes, ConfigError, ShapeError
from manyeyes.datatypes.keypoints import Keypoints

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIZES_M = (0.2, 30.0)


@dataclass(frozen=True)
class DetectorError:
    """Errors of a detector that states none of its own: one standard deviation an axis (m), of the heading modulo pi
    (rad), and the chance that the heading is off by pi. Spec: specs/pose.md 4.2, whose boxes are off by 0.25 m and
    2.5 degrees, 3 % turned.
    """

    sigma_xy_m: float = 0.25
    sigma_yaw_rad: float = 0.044
    flip: float = 0.03

    def __post_init__(self) -> None:
        if not (self.sigma_xy_m > 0 and self.sigma_yaw_rad > 0 and 0 <= self.flip <= 0.5):
            raise ConfigError(
                "DetectorError needs sigma_xy_m > 0, sigma_yaw_rad > 0 and flip in [0, 0.5]; "
                f"got {self.sigma_xy_m}, {self.sigma_yaw_rad}, {self.flip}."
            )


BODY = DetectorError(0.3, 0.03, 0.01)
"""How far the middle of a vehicle may lie off the origin of its own frame, and its heading off the frame's."""
BODY_SIZE_M = (4.5, 1.9)


@dataclass(frozen=True)
class Landmarks:
    """N objects on the ground in one agent's frame (x forward, y left).

    xy: (N, 2) metres. yaw: (N,) radians, sure modulo pi only; flip: (N,) in [0, 0.5], the chance that it is off by
    pi. size: (N, 2) length and width (m). score: (N,) in [0, 1]. sigma_xy: (N,) one standard deviation an axis (m);
    sigma_yaw: (N,) of the yaw modulo pi (rad). instant: (N,) int64, which frame a landmark was seen in, 0 for the
    current one and counting back: objects move, so only landmarks of one instant can be the same object
    (specs/pose.md 4.8). look: (N, D) what a learned net says of how each looks (feakm.py); None where no net was asked.
    """

    xy: Floats
    yaw: Floats
    size: Floats
    score: Floats
    sigma_xy: Floats
    sigma_yaw: Floats
    flip: Floats
    instant: Ints
    look: Floats | None = None

    def __post_init__(self) -> None:
        n = len(self.xy)
        wanted = {"xy": (n, 2), "size": (n, 2)}
        if self.look is not None:
            wanted["look"] = (n, *self.look.shape[1:2])
        for field in fields(self):
            if (value := getattr(self, field.name)) is None:
                continue
            shape = value.shape
            if shape != wanted.get(field.name, (n,)):
                raise ShapeError(f"Landmarks.{field.name} needs shape {wanted.get(field.name, (n,))}; got {shape}.")

    @classmethod
    def of_boxes(cls, boxes: Boxes, error: DetectorError | None = None) -> Landmarks:
        """What decoded boxes say; a box that states no error of its own (sigma 0) gets the detector's."""
        error = error or DetectorError()
        columns = (
            boxes.center[:, :2],
            boxes.yaw,
            boxes.size[:, :2],
            boxes.score,
            boxes.sigma_xy,
            boxes.sigma_yaw,
            boxes.flip,
        )
        xy, yaw, size, score, sigma_xy, sigma_yaw, flip = (c.detach().cpu().double().numpy() for c in columns)
        stated = sigma_xy > 0
        return cls(
            xy,
            yaw,
            size,
            score,
            np.where(stated, sigma_xy, error.sigma_xy_m),
            np.where(sigma_yaw > 0, sigma_yaw, error.sigma_yaw_rad),
            np.where(stated, flip, error.flip),
            np.zeros(len(xy), np.int64),
        )

    @classmethod
    def of_keypoints(cls, points: Keypoints, error: DetectorError | None = None) -> Landmarks:
        """What described boxes say, and how they look."""
        return replace(cls.of_boxes(points.boxes, error), look=points.descriptor.detach().cpu().double().numpy())

    @classmethod
    def empty(cls) -> Landmarks:
        """None."""
        zero = np.zeros(0)
        return cls(np.zeros((0, 2)), zero, np.zeros((0, 2)), zero, zero, zero, zero, np.zeros(0, np.int64))

    def with_body(self) -> Landmarks:
        """And the vehicle itself that looks out of this frame's origin: it does not see itself, but others do."""
        one = np.ones(1)
        own = Landmarks(
            np.zeros((1, 2)),
            np.zeros(1),
            np.array([BODY_SIZE_M]),
            one,
            BODY.sigma_xy_m * one,
            BODY.sigma_yaw_rad * one,
            BODY.flip * one,
            np.zeros(1, np.int64),
        )
        return Landmarks.cat([self, own])

    @classmethod
    def cat(cls, many: Sequence[Landmarks]) -> Landmarks:
        """Several sets of one frame as one; looks are lost where one of them has none."""
        columns = [[getattr(m, f.name) for m in many] for f in fields(cls)]
        return cls(*(_joined(column) for column in columns)) if many else cls.empty()

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, index: slice | Ints | NDArray[np.bool_]) -> Landmarks:
        look = None if self.look is None else self.look[index]
        return Landmarks(*(getattr(self, f.name)[index] for f in fields(self)[:-1]), look=look)

    def moved(self, pose: Floats) -> Landmarks:
        """The same landmarks in another frame, pose (3,) = target_from_source as x, y (m), yaw (rad)."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = self.xy[:, 0], self.xy[:, 1]
        there = np.stack((c * x - s * y + pose[0], s * x + c * y + pose[1]), 1)
        return replace(self, xy=there, yaw=self.yaw + pose[2])

    def usable(self, reach_m: float, at_most: int) -> Ints:
        """Rows that can be matched, in an order that does not depend on the order given.

        Numbers are finite, sizes those of a vehicle, the place within ``reach_m`` of the middle of all; where more
        than ``at_most`` remain, those of the highest score.
        """
        numbers = np.column_stack((self.xy, self.yaw, self.size, self.score, self.sigma_xy, self.sigma_yaw, self.flip))
        good = np.isfinite(numbers).all(1) & (np.abs(self.xy) < 1e7).all(1) & (self.sigma_xy > 0) & (self.sigma_yaw > 0)
        good &= ((self.size > SIZES_M[0]) & (self.size < SIZES_M[1])).all(1)
        rows = np.flatnonzero(good)
        if len(rows):
            xy = self.xy[rows]
            rows = rows[np.hypot(*(xy - np.median(xy, 0)).T) <= reach_m]
        order = np.lexsort((*numbers[rows].T, -self.score[rows], self.instant[rows]))
        return rows[order] if len(rows) <= at_most else rows[order[self._best(rows[order], at_most)]]

    def _best(self, rows: Ints, at_most: int) -> Ints:
        """Places in rows of the highest scores, in the order of rows."""
        return np.sort(np.argsort(-self.score[rows], kind="stable")[:at_most])


def _joined(column: Sequence[Any]) -> Any:
    return None if any(part is None for part in column) else np.concatenate(column)
