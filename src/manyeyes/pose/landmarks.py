# SPDX-License-Identifier: Apache-2.0
"""Landmarks: decoded boxes as positions, headings, sizes and their uncertainties, without identities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import AgentBody, Boxes, ConfigError, ShapeError
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.numbers import Numbers, as_tensor

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIZE_RANGE_M = (0.2, 30.0)


@dataclass(frozen=True)
class DetectorUncertainty:
    """Errors of a detector that states none of its own: one standard deviation per axis (m), of the heading modulo pi (rad), and
    the probability that the heading is off by pi. The defaults are 0.25 m, 4 degrees and 6 %, as measured on pairs of real boxes.
    """

    sigma_xy_m: float = 0.25
    sigma_yaw_rad: float = 0.07
    p_flip: float = 0.06

    def __post_init__(self) -> None:
        if not (self.sigma_xy_m > 0 and self.sigma_yaw_rad > 0 and 0 <= self.p_flip <= 0.5):
            raise ConfigError(
                "DetectorUncertainty needs sigma_xy_m > 0, sigma_yaw_rad > 0 and p_flip in [0, 0.5]; "
                f"got {self.sigma_xy_m}, {self.sigma_yaw_rad}, {self.p_flip}."
            )


KNOWN_BODY_UNCERTAINTY = DetectorUncertainty(0.1, 0.02, 0.01)
"""Error of a vehicle's own box where its place in the vehicle's frame is known."""
UNKNOWN_BODY_UNCERTAINTY = DetectorUncertainty(1.0, 0.03, 0.01)
"""Distance of a vehicle's middle from the origin of its frame where it is unknown: formats put it up to 2 m behind or ahead."""
UNKNOWN_BODY_SIZE_M = (4.5, 1.9)


@dataclass(frozen=True)
class Landmarks:
    """N objects on the ground in one agent's frame (x forward, y left).

    xy: (N, 2) metres. yaw: (N,) radians, certain modulo pi only; p_flip: (N,) in [0, 0.5], the probability that it is off by
    pi. size: (N, 2) length and width (m). score: (N,) in [0, 1]. sigma_xy: (N,) one standard deviation per axis (m);
    sigma_yaw: (N,) of the yaw modulo pi (rad). instant: (N,) int64, the frame of a landmark, 0 for the current one and counting
    back: objects move, so only landmarks of one instant are matched. descriptor: (N, D) learned descriptors (feakm.py), or None.
    """

    xy: Floats
    yaw: Floats
    size: Floats
    score: Floats
    sigma_xy: Floats
    sigma_yaw: Floats
    p_flip: Floats
    instant: Ints
    descriptor: Floats | None = None

    def __post_init__(self) -> None:
        n = len(self.xy)
        wanted = {"xy": (n, 2), "size": (n, 2)}
        if self.descriptor is not None:
            wanted["descriptor"] = (n, *self.descriptor.shape[1:2])
        for field in fields(self):
            if (value := getattr(self, field.name)) is None:
                continue
            shape = value.shape
            if shape != wanted.get(field.name, (n,)):
                raise ShapeError(f"Landmarks.{field.name} needs shape {wanted.get(field.name, (n,))}; got {shape}.")

    @classmethod
    def of(cls, objects: Landmarks | Boxes | Numbers) -> Landmarks:
        """Return landmarks of boxes, or of an array: (N, 7) centre x, y, z, length, width, height (m) and yaw (rad), or (N, 6) x, y
        (m), yaw (rad), length, width (m) and score. Boxes of arrays get the errors of DetectorUncertainty.

        Raises:
            ShapeError: the array has another shape.
        """
        if isinstance(objects, Landmarks):
            return objects
        if not isinstance(objects, Boxes):
            rows = as_tensor(objects, "Landmarks.of", torch.float64)
            if rows.ndim != 2 or rows.shape[1] not in (6, 7):
                raise ShapeError(
                    "Landmarks.of needs boxes (N, 7): x, y, z, length, width, height, yaw; "
                    f"or (N, 6): x, y, yaw, length, width, score; got {tuple(rows.shape)}."
                )
            objects = (
                Boxes.of(rows[:, :3], rows[:, 3:6], rows[:, 6]) if rows.shape[1] == 7 else _boxes_of_planar_rows(rows)
            )
        return cls.of_boxes(objects)

    @classmethod
    def of_boxes(cls, boxes: Boxes, error: DetectorUncertainty | None = None) -> Landmarks:
        """Return landmarks of decoded boxes; a box that states no error of its own (sigma 0) gets the detector's."""
        error = error or DetectorUncertainty()
        columns = (
            boxes.center[:, :2],
            boxes.yaw,
            boxes.size[:, :2],
            boxes.score,
            boxes.sigma_xy,
            boxes.sigma_yaw,
            boxes.p_flip,
        )
        xy, yaw, size, score, sigma_xy, sigma_yaw, p_flip = (c.detach().cpu().double().numpy() for c in columns)
        stated = sigma_xy > 0
        return cls(
            xy,
            yaw,
            size,
            score,
            np.where(stated, sigma_xy, error.sigma_xy_m),
            np.where(sigma_yaw > 0, sigma_yaw, error.sigma_yaw_rad),
            np.where(stated, p_flip, error.p_flip),
            np.zeros(len(xy), np.int64),
        )

    @classmethod
    def of_keypoints(cls, points: Keypoints, error: DetectorUncertainty | None = None) -> Landmarks:
        """Return the landmarks of boxes with their descriptors."""
        return replace(cls.of_boxes(points.boxes, error), descriptor=points.descriptor.detach().cpu().double().numpy())

    @classmethod
    def empty(cls) -> Landmarks:
        """Return a set without any landmark."""
        zero = np.zeros(0)
        return cls(np.zeros((0, 2)), zero, np.zeros((0, 2)), zero, zero, zero, zero, np.zeros(0, np.int64))

    def with_body(self, body: AgentBody | None, error: DetectorUncertainty | None = None) -> Landmarks:
        """Append the vehicle that carries the sensor: other agents observe it, its own sensor does not.

        body: in the frame of the landmarks; None: unknown, a car near the origin with a large uncertainty. error: of body, that of
        a stated one by default.
        """
        error = error or (UNKNOWN_BODY_UNCERTAINTY if body is None else KNOWN_BODY_UNCERTAINTY)
        xy, yaw_rad, size = (0.0, 0.0), 0.0, UNKNOWN_BODY_SIZE_M
        if body is not None:
            xy, yaw_rad, size = body.center[:2], body.yaw_rad, body.size[:2]
        own = Landmarks(
            np.array([xy]),
            np.array([yaw_rad]),
            np.array([size]),
            np.ones(1),
            np.array([error.sigma_xy_m]),
            np.array([error.sigma_yaw_rad]),
            np.array([error.p_flip]),
            np.zeros(1, np.int64),
        )
        return Landmarks.cat([self, own])

    @classmethod
    def cat(cls, many: Sequence[Landmarks]) -> Landmarks:
        """Concatenate several sets of one frame; descriptors are dropped where one of the sets has none."""
        columns = [[getattr(m, f.name) for m in many] for f in fields(cls)]
        return cls(*(_concatenate(column) for column in columns)) if many else cls.empty()

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, index: slice | Ints | NDArray[np.bool_]) -> Landmarks:
        descriptor = None if self.descriptor is None else self.descriptor[index]
        return Landmarks(*(getattr(self, f.name)[index] for f in fields(self)[:-1]), descriptor=descriptor)

    def transform(self, target_from_source: Floats) -> Landmarks:
        """Return the same landmarks in another frame; target_from_source: (3,) x, y (m), yaw (rad)."""
        c, s = np.cos(target_from_source[2]), np.sin(target_from_source[2])
        x, y = self.xy[:, 0], self.xy[:, 1]
        there = np.stack((c * x - s * y + target_from_source[0], s * x + c * y + target_from_source[1]), 1)
        return replace(self, xy=there, yaw=self.yaw + target_from_source[2])

    def select_indices(self, max_range_m: float, max_count: int) -> Ints:
        """Return indices of usable landmarks, in an order that does not depend on the order given.

        Usable: all values are finite, the size is that of a vehicle, and the position is within ``max_range_m`` of the median of
        all. At most ``max_count`` are returned, those of the highest score.
        """
        numbers = np.column_stack(
            (self.xy, self.yaw, self.size, self.score, self.sigma_xy, self.sigma_yaw, self.p_flip)
        )
        good = np.isfinite(numbers).all(1) & (np.abs(self.xy) < 1e7).all(1) & (self.sigma_xy > 0) & (self.sigma_yaw > 0)
        good &= ((self.size > SIZE_RANGE_M[0]) & (self.size < SIZE_RANGE_M[1])).all(1)
        rows = np.flatnonzero(good)
        if len(rows):
            xy = self.xy[rows]
            rows = rows[np.hypot(*(xy - np.median(xy, 0)).T) <= max_range_m]
        order = np.lexsort((*numbers[rows].T, -self.score[rows], self.instant[rows]))
        return rows[order] if len(rows) <= max_count else rows[order[self._select_best(rows[order], max_count)]]

    def _select_best(self, rows: Ints, max_count: int) -> Ints:
        """Return positions in rows of the highest scores, in the order of rows."""
        return np.sort(np.argsort(-self.score[rows], kind="stable")[:max_count])


def _boxes_of_planar_rows(rows: torch.Tensor) -> Boxes:
    """Return boxes on the ground of rows (N, 6): x, y, yaw, length, width, score."""
    flat = torch.zeros(len(rows), 1, dtype=rows.dtype)
    boxes = Boxes.of(torch.cat((rows[:, :2], flat), 1), torch.cat((rows[:, 3:5], flat + 1.0), 1), rows[:, 2])
    return replace(boxes, score=rows[:, 5])


def _concatenate(column: Sequence[Any]) -> Any:
    return None if any(part is None for part in column) else np.concatenate(column)
