# SPDX-License-Identifier: Apache-2.0
"""Intersection over union of oriented rectangles on the ground and of upright boxes, vectorised and differentiable.

The corners of the intersection of two convex quadrilaterals are among 24 candidates: the 8 corners (those that lie in
the other rectangle) and the 16 crossings of their edges. Sorted by angle about their mean they bound the intersection,
whose area is the shoelace sum. Everything is computed in the frame of the first rectangle, so that world coordinates of
kilometres cost no digits. Pairs whose circumscribed circles do not meet are never clipped.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes, ShapeError

_CORNER_SIGNS = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))


def pairwise_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return rotated bird's-eye IoU (N, M) of boxes a (N, 5) and b (M, 5), each x, y, length, width (m), yaw (rad).

    Differentiable in both; zero where a box is degenerate or not finite. Matching is done in float64 by its callers.
    """
    a, b = _check_boxes(a), _check_boxes(b)
    with torch.no_grad():
        row, column = near_pairs(a, b).nonzero(as_tuple=True)
    overlap = _iou(a[row], b[column])
    return overlap.new_zeros(a.shape[0], b.shape[0]).index_put((row, column), overlap)


def aligned_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return rotated bird's-eye IoU (N,) of box i of a (N, 5) with box i of b (N, 5); differentiable, for a loss."""
    a, b = _check_boxes(a), _check_boxes(b)
    if a.shape != b.shape:
        raise ShapeError(f"aligned_iou needs as many boxes on both sides; got {a.shape[0]} and {b.shape[0]}.")
    with torch.no_grad():
        distance = torch.linalg.vector_norm(a[:, :2] - b[:, :2], dim=-1)
        near = ((distance <= _radius(a) + _radius(b)) & _solid(a) & _solid(b)).nonzero(as_tuple=True)
    overlap = _iou(a[near], b[near])
    return overlap.new_zeros(a.shape[0]).index_put(near, overlap)


def pairwise_iou_3d(a: Boxes, b: Boxes) -> Tensor:
    """Return the IoU (N, M) of the volumes of boxes that stand upright in one frame; differentiable in both.

    Zero where a box has no volume or is not finite: the area that two rectangles share times the height that they share is exact.
    """
    with torch.no_grad():
        row, column = near_pairs(_check_boxes(a.bev()), _check_boxes(b.bev())).nonzero(as_tuple=True)
    one, other = a[row], b[column]
    top = torch.minimum(one.center[:, 2] + one.size[:, 2] / 2, other.center[:, 2] + other.size[:, 2] / 2)
    bottom = torch.maximum(one.center[:, 2] - one.size[:, 2] / 2, other.center[:, 2] - other.size[:, 2] / 2)
    shared = _intersection_area(one.bev(), other.bev()) * (top - bottom).clamp_min(0)
    union = one.size.prod(1) + other.size.prod(1) - shared
    solid = (union > 1e-9) & (one.size > 0).all(1) & (other.size > 0).all(1) & shared.isfinite()
    overlap = torch.where(solid, shared / torch.where(solid, union, 1.0), 0.0)
    return overlap.new_zeros(len(a), len(b)).index_put((row, column), overlap)


def near_pairs(a: Tensor, b: Tensor) -> Tensor:
    """Return (N, M) bool: pairs of boxes (N, 5), (M, 5) whose circumscribed circles meet and which both have an area."""
    difference = a[:, None, :2] - b[None, :, :2]
    close = difference.square().sum(-1) <= (_radius(a)[:, None] + _radius(b)[None]).square()
    return close & _solid(a)[:, None] & _solid(b)[None]


def _check_boxes(boxes: Tensor) -> Tensor:
    if boxes.ndim != 2 or boxes.shape[1] != 5 or not boxes.is_floating_point():
        raise ShapeError(f"Boxes for an IoU are floats (N, 5): x, y, length, width, yaw; got {tuple(boxes.shape)}.")
    return boxes


def _radius(boxes: Tensor) -> Tensor:
    return torch.hypot(boxes[:, 2], boxes[:, 3]) / 2


def _solid(boxes: Tensor) -> Tensor:
    return (boxes[:, 2] > 0) & (boxes[:, 3] > 0) & boxes.isfinite().all(-1)


def _iou(a: Tensor, b: Tensor) -> Tensor:
    """Return IoU (P,) of pairs of solid boxes (P, 5)."""
    shared = _intersection_area(a, b)
    union = a[:, 2] * a[:, 3] + b[:, 2] * b[:, 3] - shared
    solid = union > 1e-9
    return torch.where(solid, shared / torch.where(solid, union, 1.0), 0.0)


def _intersection_area(a: Tensor, b: Tensor) -> Tensor:
    """Return the area (P,) shared by pairs of boxes (P, 5), in square metres."""
    double = torch.promote_types(a.dtype, b.dtype) == torch.float64
    inside_by, parallel_below = (1e-9, 1e-12) if double else (1e-5, 1e-6)
    signs = torch.tensor(_CORNER_SIGNS, dtype=a.dtype, device=a.device)
    ours = signs * a[:, None, 2:4]
    theirs = _into(signs * b[:, None, 2:4], a, b)
    ours_in_b = ((_into(ours, b, a).abs() - b[:, None, 2:4] / 2) <= inside_by).all(-1)
    theirs_in_a = ((theirs.abs() - a[:, None, 2:4] / 2) <= inside_by).all(-1)
    crossing, crosses = _edge_crossings(ours, theirs, parallel_below)
    return _hull_area(torch.cat((ours, theirs, crossing), 1), torch.cat((ours_in_b, theirs_in_a, crosses), 1))


def _into(points: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Transform points (P, K, 2) from the frame of box b to that of box a."""
    turn, ca, sa = b[:, 4] - a[:, 4], a[:, 4].cos(), a[:, 4].sin()
    c, s = turn.cos()[:, None], turn.sin()[:, None]
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    x = points[..., 0] * c - points[..., 1] * s + (dx * ca + dy * sa)[:, None]
    y = points[..., 0] * s + points[..., 1] * c + (dy * ca - dx * sa)[:, None]
    return torch.stack((x, y), -1)


def _edge_crossings(p: Tensor, q: Tensor, parallel_below: float) -> tuple[Tensor, Tensor]:
    """Return crossings (P, 16, 2) of the edges of two quadrilaterals (P, 4, 2), and which of them exist (P, 16).

    Parallel edges have none: where they overlap, the corners already bound what is shared.
    """
    u, v = (p.roll(-1, 1) - p)[:, :, None], (q.roll(-1, 1) - q)[:, None]
    gap = q[:, None] - p[:, :, None]
    sine = _cross(u, v)
    with torch.no_grad():
        lengths = torch.linalg.vector_norm(u, dim=-1) * torch.linalg.vector_norm(v, dim=-1)
        meets = sine.abs() > parallel_below * lengths
    sine = torch.where(meets, sine, 1.0)
    along_p, along_q = _cross(gap, v) / sine, _cross(gap, u) / sine
    exists = meets & (along_p >= 0) & (along_p <= 1) & (along_q >= 0) & (along_q <= 1)
    # A parallel pair's `along` is meaningless and may be huge; it is cut off before it can reach a gradient.
    crossing = p[:, :, None] + torch.where(exists, along_p, 0.0)[..., None] * u
    return crossing.flatten(1, 2), exists.flatten(1)


def _cross(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _hull_area(points: Tensor, valid: Tensor) -> Tensor:
    """Return the area (P,) of the convex polygons whose corners are the valid ones of points (P, K, 2), in any order."""
    with torch.no_grad():
        count = valid.sum(1, keepdim=True).clamp_min(1)
        middle = (points * valid[..., None]).sum(1, keepdim=True) / count[..., None]
        angle = torch.atan2(points[..., 1] - middle[..., 1], points[..., 0] - middle[..., 0])
        order = torch.where(valid, angle, torch.inf).argsort(1)
    ring = points.gather(1, order[..., None].expand_as(points))
    ring = torch.where(valid.gather(1, order)[..., None], ring, ring[:, :1])
    area = _cross(ring - ring[:, :1], ring.roll(-1, 1) - ring[:, :1]).sum(1) / 2
    return torch.where(valid.sum(1) >= 3, area, 0.0).clamp_min(0)
