# SPDX-License-Identifier: Apache-2.0
"""Greedy non-maximum suppression of oriented boxes on the ground, in compiled loops.

Only boxes that still stand are compared, each with those after it whose circumscribed circle meets its own: a rectangle is clipped
by the four sides of the other, in the other's frame (Sutherland and Hodgman 1974). :mod:`manyeyes.ops.box_iou` is the twin.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import Boolx1, F64x1, F64x2, njit, set_row
from manyeyes.datatypes import ShapeError

MAX_CANDIDATES = 1000
"""Default number of boxes of highest score that are compared."""


@torch.no_grad()
def rotated_nms(boxes: Tensor, score: Tensor, iou_threshold: float, max_candidates: int = MAX_CANDIDATES) -> Tensor:
    """Return rows (K,) int64 of boxes (N, 5: x, y, length, width, yaw) that survive, in descending score (N,).

    The best `max_candidates` boxes are walked from the highest score, equal scores in the order given; each that still stands
    suppresses those after it whose rotated IoU with it is *greater* than the threshold.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 5 or score.shape != boxes.shape[:1]:
        raise ShapeError(
            f"rotated_nms needs boxes (N, 5) and score (N,); got {tuple(boxes.shape)}, {tuple(score.shape)}."
        )
    order = score.argsort(descending=True, stable=True)[:max_candidates]
    candidates = np.ascontiguousarray(boxes[order].double().cpu().numpy())
    standing = find_kept(candidates, float(iou_threshold), len(candidates))
    return order[torch.from_numpy(standing).to(order.device)]


@njit(cache=True, nogil=True)
def find_kept(boxes: F64x2, threshold: float, max_kept: int) -> Boolx1:  # pragma: no cover
    """Return which of boxes (N, 5), best first, no better one that stands overlaps by more than the threshold.

    max_kept: the search ends with so many; boxes behind the last of them are not kept.
    """
    n = boxes.shape[0]
    standing, solid, near = np.ones(n, np.bool_), np.empty(n, np.bool_), np.empty(n, np.bool_)
    x, y, radius = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        solid[i] = boxes[i, 2] > 0 and boxes[i, 3] > 0 and np.isfinite(boxes[i]).all()
        radius[i] = np.hypot(boxes[i, 2], boxes[i, 3]) / 2
        # A comparison with NaN is false: what is not solid is near to nothing.
        x[i], y[i] = boxes[i, 0] if solid[i] else np.nan, boxes[i, 1]
    ring, clipped = np.empty((20, 2)), np.empty((20, 2))  # a clip adds half a ring at most, however numbers round
    kept = 0
    for i in range(n):
        if not standing[i]:
            continue
        kept += 1
        if kept == max_kept:
            standing[i + 1 :] = False
            break
        if not solid[i]:
            continue
        _mark_near(x[i:], y[i:], radius[i:], near[i:])
        c, s = np.cos(boxes[i, 4]), np.sin(boxes[i, 4])
        for j in range(i + 1, n):
            if not (near[j] and standing[j]):
                continue
            shared = _compute_shared_area(boxes[i], c, s, boxes[j], ring, clipped)
            union = boxes[i, 2] * boxes[i, 3] + boxes[j, 2] * boxes[j, 3] - shared
            if union > 1e-9 and shared / union > threshold:
                standing[j] = False
    return standing


@njit(cache=True, nogil=True)
def _mark_near(x: F64x1, y: F64x1, radius: F64x1, near: Boolx1) -> None:  # pragma: no cover
    """Mark circles (N,) that meet the first; without branches, so that the loop is of vectors."""
    for j in range(np.uintp(x.shape[0])):
        dx, dy, reach = x[j] - x[0], y[j] - y[0], radius[0] + radius[j]
        near[j] = dx * dx + dy * dy <= reach * reach


@njit(cache=True, nogil=True)
def _compute_shared_area(
    a: F64x1, c: float, s: float, b: F64x1, ring: F64x2, clipped: F64x2
) -> float:  # pragma: no cover
    """Return the area that two solid boxes (5,) share.

    c, s: cosine and sine of the yaw of a. ring and clipped: (20, 2) to work in.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    x0, y0 = dx * c + dy * s, dy * c - dx * s
    ct, st = np.cos(b[4] - a[4]) / 2, np.sin(b[4] - a[4]) / 2
    count = 4
    for k in range(4):
        u, v = (b[2] if k < 2 else -b[2]), (b[3] if k == 1 or k == 2 else -b[3])
        ring[k, 0], ring[k, 1] = x0 + u * ct - v * st, y0 + u * st + v * ct
    for side in range(4):
        axis, sign, half = side // 2, 1.0 - 2.0 * (side % 2), a[2 + side // 2] / 2
        kept = 0
        for k in range(count):
            after = k + 1 if k + 1 < count else 0
            p, q = half - sign * ring[k, axis], half - sign * ring[after, axis]
            if p >= 0:
                set_row(clipped[kept], ring[k])
                kept += 1
            if (p > 0 and q < 0) or (p < 0 and q > 0):
                for c in range(2):
                    clipped[kept, c] = ring[k, c] + (ring[after, c] - ring[k, c]) * (p / (p - q))
                kept += 1
        count = kept
        for k in range(count):
            set_row(ring[k], clipped[k])
    area = 0.0
    for k in range(1, count - 1):
        area += (ring[k, 0] - ring[0, 0]) * (ring[k + 1, 1] - ring[0, 1])
        area -= (ring[k, 1] - ring[0, 1]) * (ring[k + 1, 0] - ring[0, 0])
    return max(area / 2, 0.0)
