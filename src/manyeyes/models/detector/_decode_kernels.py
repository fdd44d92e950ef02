# SPDX-License-Identifier: Apache-2.0
"""Decode raw boxes of one grid in one compiled call; ``box_head`` holds the reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, I64x1, njit
from manyeyes.ops._sort_kernels import argsort
from manyeyes.ops.nms import find_kept


class RawColumns(NamedTuple):
    """First columns of the quantities of a raw box, number of labels, and typical size, metres."""

    offset: int
    z: int
    log_size: int
    axis: int
    direction: int
    kind: int
    sigma_xy: int
    sigma_yaw: int
    iou: int
    velocity: int
    num_kinds: int
    speed_unit: float
    length: float
    width: float
    height: float


class DecodeLimits(NamedTuple):
    """The numbers of a ``DecodeConfig``, and the number of candidates of non-maximum suppression."""

    score_threshold: float
    nms_iou: float
    max_boxes: int
    iou_score_weight: float
    max_candidates: int


class DecodedBoxes(NamedTuple):
    """Columns of Boxes by falling score: (N, 3), (N, 3), (N,) ... and velocity (N, 2)."""

    center: F32x2
    size: F32x2
    yaw: F32x1
    score: F32x1
    label: I64x1
    sigma_xy: F32x1
    sigma_yaw: F32x1
    p_flip: F32x1
    velocity: F32x2


@njit(cache=True, nogil=True)
def _sigmoid(x: float) -> float:  # pragma: no cover
    return 1.0 / (1.0 + np.exp(-x))


@njit(cache=True, nogil=True)
def _scores(raw: F32x2, heat: F32x1, iou: int, weight: float, threshold: float) -> F32x1:  # pragma: no cover
    """Return scores (N,) of raw boxes; 0 where the heat alone excludes a score above the threshold."""
    score = np.zeros(len(raw), np.float32)
    low = _min_heat(weight, threshold)
    for i in range(len(raw)):
        if heat[i] < low:
            continue
        score[i] = _sigmoid(np.float64(heat[i])) ** (1.0 - weight) * _sigmoid(np.float64(raw[i, iou])) ** weight
    return score


@njit(cache=True, nogil=True)
def _min_heat(weight: float, threshold: float) -> float:  # pragma: no cover
    """Return a logit below which no score exceeds the threshold, with a margin for rounding: the IoU is at most 1."""
    if not (0.0 < threshold < 1.0 and 0.0 <= weight < 1.0):
        return -np.inf
    min_heat = threshold ** (1.0 / (1.0 - weight))
    return np.log(min_heat / (1.0 - min_heat)) - 1e-3


@njit(cache=True, nogil=True)
def _decode_row(
    row: F32x1, xy: F32x1, cell_m: float, columns: RawColumns, to: DecodedBoxes, i: int
) -> None:  # pragma: no cover
    """Write box i, apart from its score."""
    for k in range(2):
        to.center[i, k] = xy[k] + row[columns.offset + k] * np.float32(cell_m)
        to.velocity[i, k] = row[columns.velocity + k] * np.float32(columns.speed_unit)
    to.center[i, 2] = row[columns.z]
    typical = (columns.length, columns.width, columns.height)
    for k in range(3):
        to.size[i, k] = typical[k] * np.exp(min(max(np.float64(row[columns.log_size + k]), -3.0), 3.0))
    yaw = np.arctan2(np.float64(row[columns.axis + 1]), np.float64(row[columns.axis])) / 2.0
    ahead = _sigmoid(row[columns.direction] * np.cos(yaw) + row[columns.direction + 1] * np.sin(yaw))
    if ahead < 0.5:
        yaw += np.pi
    to.yaw[i] = np.arctan2(np.sin(yaw), np.cos(yaw))
    to.p_flip[i] = min(ahead, 1.0 - ahead)
    to.label[i] = np.argmax(row[columns.kind : columns.kind + columns.num_kinds])
    to.sigma_xy[i], to.sigma_yaw[i] = np.exp(row[columns.sigma_xy]), np.exp(row[columns.sigma_yaw])


@njit(cache=True, nogil=True)
def decode_grid(
    raw: F32x2, xy: F32x2, heat: F32x1, cell_m: float, columns: RawColumns, limits: DecodeLimits
) -> DecodedBoxes:  # pragma: no cover
    """Return the boxes of raw boxes (N, total) on cells at xy (N, 2), with heat logits (N,)."""
    score = _scores(raw, heat, columns.iou, limits.iou_score_weight, limits.score_threshold)
    rows = np.flatnonzero(score > limits.score_threshold)
    rows = rows[argsort(-score[rows])]
    n = len(rows)
    found = _empty(n)
    for i in range(n):
        _decode_row(raw[rows[i]], xy[rows[i]], cell_m, columns, found, i)
        found.score[i] = score[rows[i]]
    ground = np.empty((min(n, limits.max_candidates), 5))
    for i in range(len(ground)):
        ground[i, 0], ground[i, 1], ground[i, 4] = found.center[i, 0], found.center[i, 1], found.yaw[i]
        ground[i, 2], ground[i, 3] = found.size[i, 0], found.size[i, 1]
    kept = np.flatnonzero(find_kept(ground, limits.nms_iou, limits.max_boxes))[: limits.max_boxes]
    return DecodedBoxes(
        found.center[kept],
        found.size[kept],
        found.yaw[kept],
        found.score[kept],
        found.label[kept],
        found.sigma_xy[kept],
        found.sigma_yaw[kept],
        found.p_flip[kept],
        found.velocity[kept],
    )


@njit(cache=True, nogil=True)
def _empty(n: int) -> DecodedBoxes:  # pragma: no cover
    center, size, velocity = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty((n, 2), np.float32)
    numbers = np.empty((5, n), np.float32)
    return DecodedBoxes(
        center, size, numbers[0], numbers[1], np.empty(n, np.int64), numbers[2], numbers[3], numbers[4], velocity
    )
