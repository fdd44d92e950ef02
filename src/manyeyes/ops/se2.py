# SPDX-License-Identifier: Apache-2.0
"""Poses in the plane: their algebra, and least squares on a graph of them.

A pose is a tensor (..., 3) of x, y (m) and yaw (rad), target_from_source like every other motion here: ``compose(a_from_b,
b_from_c) = a_from_c``. A tangent (..., 3) is vx, vy, omega. Derivatives are with respect to a small motion on the right,
``compose(pose, exp(delta))``. Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv 1812.01537, section on SE(2). Closed forms are written with sinc, so that they hold at zero without a branch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import ConfigError, ShapeError, wrap_angle


def compose(a: Tensor, b: Tensor) -> Tensor:
    """a_from_b (..., 3) then b_from_c (..., 3) as a_from_c, yaw in [-pi, pi)."""
    c, s = a[..., 2].cos(), a[..., 2].sin()
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return torch.stack((x, y, wrap_angle(a[..., 2] + b[..., 2])), -1)


def inverse(a: Tensor) -> Tensor:
    """source_from_target of target_from_source (..., 3)."""
    c, s = a[..., 2].cos(), a[..., 2].sin()
    return torch.stack((-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap_angle(-a[..., 2])), -1)


def between(a: Tensor, b: Tensor) -> Tensor:
    """inverse(a) then b: where b is, seen from a, for poses (..., 3) in one frame."""
    return compose(inverse(a), b)


def exp(tangent: Tensor) -> Tensor:
    """Return the pose (..., 3) reached in unit time at constant body velocity vx, vy, omega (..., 3)."""
    vx, vy, omega = tangent.unbind(-1)
    sine_factor = torch.sinc(omega / math.pi)
    cosine_factor = omega / 2 * torch.sinc(omega / (2 * math.pi)).square()
    return torch.stack(
        (sine_factor * vx - cosine_factor * vy, cosine_factor * vx + sine_factor * vy, wrap_angle(omega)), -1
    )


def log(pose: Tensor) -> Tensor:
    """Return the tangent (..., 3) with |omega| <= pi that :func:`exp` takes to the pose (..., 3)."""
    x, y = pose[..., 0], pose[..., 1]
    omega = wrap_angle(pose[..., 2])
    half, k = omega / 2, _half_cot(omega)
    return torch.stack((k * x + half * y, k * y - half * x, omega), -1)


def adjoint(pose: Tensor) -> Tensor:
    """Return (..., 3, 3): compose(pose, exp(d)) = compose(exp(adjoint(pose) d), pose)."""
    c, s = pose[..., 2].cos(), pose[..., 2].sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return _matrix(((c, -s, pose[..., 1]), (s, c, -pose[..., 0]), (zero, zero, one)))


def right_jacobian_inverse(tangent: Tensor) -> Tensor:
    """Return (..., 3, 3), the derivative of log(compose(exp(tangent), exp(d))) in d at 0."""
    vx, vy, omega = tangent.unbind(-1)
    k, half = _half_cot(omega), omega / 2
    # (1 - k) / omega; by its series where the difference has lost its digits.
    small = omega.abs() < 1e-2
    bend = torch.where(small, omega / 12 + omega**3 / 720, (1 - k) / torch.where(small, 1.0, omega))
    zero, one = torch.zeros_like(k), torch.ones_like(k)
    return _matrix(((k, -half, bend * vx + vy / 2), (half, k, bend * vy - vx / 2), (zero, zero, one)))


def _half_cot(omega: Tensor) -> Tensor:
    """Return (omega / 2) cot(omega / 2)."""
    return (omega / 2).cos() / torch.sinc(omega / (2 * math.pi))


def _matrix(rows: tuple[tuple[Tensor, ...], ...]) -> Tensor:
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


@dataclass(frozen=True)
class PoseGraphEdges:
    """E measurements of pose j seen from pose i.

    i, j: (E,) int64, rows of the poses, i != j. measured: (E, 3), i_from_j. information: (E, 3, 3), the inverse
    covariance of the measurement's error as a small motion on its right (m, m, rad, in the axes of j). A prior on a pose
    is an edge from a fixed pose.
    """

    i: Tensor
    j: Tensor
    measured: Tensor
    information: Tensor

    def __post_init__(self) -> None:
        n = self.i.shape[0]
        wanted = {"i": (n,), "j": (n,), "measured": (n, 3), "information": (n, 3, 3)}
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ShapeError(f"PoseGraphEdges.{name} needs shape {shape}; got {tuple(getattr(self, name).shape)}.")
        if bool((self.i == self.j).any()):
            raise ShapeError(
                f"An edge joins two poses; edge {int((self.i == self.j).nonzero()[0, 0])} joins one to itself."
            )


@dataclass(frozen=True)
class PoseGraphSolution:
    """Poses (N, 3) of least cost, and what is known of them.

    covariance: (3 N, 3 N) of x, y (m, in the axes of the poses' own frame) and yaw (rad), N blocks of 3; zero for fixed
    poses; infinite throughout where the graph leaves some pose undetermined. cost: half the (robust) squared error.
    """

    poses: Tensor
    covariance: Tensor
    cost: float
    iterations: int
    converged: bool


@torch.no_grad()
def solve_pose_graph(
    initial: Tensor, edges: PoseGraphEdges, fixed: Tensor, huber: float | None = None, iterations: int = 50
) -> PoseGraphSolution:
    """Return poses (N, 3) that fit the edges best, by Levenberg-Marquardt from `initial`; those `fixed` (N,) bool stay.

    Minimises 1/2 sum rho(r' information r) over r = log(measured^-1 i^-1 j), rho the identity or Huber's function at
    `huber` standard deviations. The covariance is the inverse of the last Gauss-Newton matrix, in float64.
    """
    _check(initial, edges, fixed, huber)
    poses = initial.double()
    edges = PoseGraphEdges(edges.i, edges.j, edges.measured.double(), edges.information.double())
    free = (~fixed).repeat_interleave(3).nonzero()[:, 0]
    cost, damping, done, round_ = _cost(poses, edges, huber), 1e-4, len(free) == 0, 0
    while not done and round_ < iterations:
        round_ += 1
        gradient, curvature = _normal_equations(poses, edges, huber)
        gradient, curvature = gradient[free], curvature[free][:, free]
        while True:
            damped = curvature + (damping * curvature.diagonal().clamp_min(1e-9)).diag()
            step = poses.new_zeros(poses.numel())
            step[free] = -torch.linalg.solve(damped, gradient)
            moved = torch.where(fixed[:, None], poses, compose(poses, exp(step.view(-1, 3))))
            moved_cost = _cost(moved, edges, huber)
            # No damped step lowers the cost any more: rounding, or a cost that overflows.
            done = float(step.abs().max()) < 1e-7 or damping > 1e12
            if moved_cost <= cost or done:
                break
            damping *= 10
        if moved_cost <= cost:
            poses, cost, damping = moved, moved_cost, max(damping / 10, 1e-12)
    return PoseGraphSolution(
        poses.to(initial.dtype), _covariance(poses, edges, free, huber).to(initial.dtype), cost, round_, done
    )


def edge_error(poses: Tensor, edges: PoseGraphEdges) -> Tensor:
    """What each edge is off by, (E, 3): log(measured^-1 i^-1 j) for poses (N, 3). Differentiable."""
    return log(compose(inverse(edges.measured), between(poses[edges.i], poses[edges.j])))


def edge_jacobians(poses: Tensor, edges: PoseGraphEdges) -> tuple[Tensor, Tensor]:
    """Derivatives (E, 3, 3), (E, 3, 3) of :func:`edge_error` with respect to small motions on the right of i and of j."""
    by_j = right_jacobian_inverse(edge_error(poses, edges))
    return -by_j @ adjoint(between(poses[edges.j], poses[edges.i])), by_j


def _check(initial: Tensor, edges: PoseGraphEdges, fixed: Tensor, huber: float | None) -> None:
    n = initial.shape[0]
    if initial.shape != (n, 3) or fixed.shape != (n,) or fixed.dtype != torch.bool:
        raise ShapeError(
            f"solve_pose_graph needs poses (N, 3) and fixed (N,) bool; got {tuple(initial.shape)}, {tuple(fixed.shape)}."
        )
    if len(edges.i) and not bool(
        ((torch.stack((edges.i, edges.j)) >= 0) & (torch.stack((edges.i, edges.j)) < n)).all()
    ):
        raise ShapeError(f"An edge names a pose that does not exist; there are {n}.")
    if not bool(initial.isfinite().all() and edges.measured.isfinite().all() and edges.information.isfinite().all()):
        raise ConfigError(
            "solve_pose_graph needs finite poses, measurements and information; drop what is NaN or infinite first."
        )
    if not bool(fixed.any()):
        raise ConfigError(
            "solve_pose_graph needs at least one fixed pose: edges alone leave the whole graph free to move."
        )
    if huber is not None and huber <= 0:
        raise ConfigError(f"huber is a number of standard deviations above 0, or None; got {huber}.")


def _square_errors(error: Tensor, edges: PoseGraphEdges) -> Tensor:
    return torch.einsum("ea,eab,eb->e", error, edges.information, error)


def _cost(poses: Tensor, edges: PoseGraphEdges, huber: float | None) -> float:
    squared = _square_errors(edge_error(poses, edges), edges)
    if huber is not None:
        squared = torch.where(squared <= huber**2, squared, 2 * huber * squared.sqrt() - huber**2)
    return float(squared.sum()) / 2


def _normal_equations(poses: Tensor, edges: PoseGraphEdges, huber: float | None) -> tuple[Tensor, Tensor]:
    """Gradient (3 N,) and Gauss-Newton matrix (3 N, 3 N) of the cost."""
    n = len(poses)
    error, (by_i, by_j) = edge_error(poses, edges), edge_jacobians(poses, edges)
    information = edges.information
    if huber is not None:
        size = _square_errors(error, edges).sqrt()
        information = information * torch.where(size > huber, huber / size.clamp_min(huber), 1.0)[:, None, None]
    gradient = poses.new_zeros(n, 3)
    curvature = poses.new_zeros(n * n, 3, 3)
    sides = ((edges.i, by_i), (edges.j, by_j))
    for row, left in sides:
        weighted = left.mT @ information
        gradient.index_add_(0, row, (weighted @ error[..., None])[..., 0])
        for column, right in sides:
            curvature.index_add_(0, row * n + column, weighted @ right)
    return gradient.flatten(), curvature.view(n, n, 3, 3).transpose(1, 2).reshape(3 * n, 3 * n)


def _covariance(poses: Tensor, edges: PoseGraphEdges, free: Tensor, huber: float | None) -> Tensor:
    """Return (3 N, 3 N) in x, y, yaw: the inverse of the curvature, turned from each pose's own axes to those of its frame."""
    out = poses.new_zeros(poses.numel(), poses.numel())
    curvature = _normal_equations(poses, edges, huber)[1][free][:, free]
    factor, failed = torch.linalg.cholesky_ex(curvature)
    weakest = float(factor.diagonal().min()) if len(free) else 1.0
    if int(failed) or weakest < 1e-7 * float(factor.diagonal().max() if len(free) else 1.0):
        return out + math.inf
    out[free[:, None], free] = torch.cholesky_inverse(factor)
    turn = poses.new_zeros(len(poses), 3, 3)
    turn[:, 2, 2] = 1
    c, s = poses[:, 2].cos(), poses[:, 2].sin()
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
    blocks = torch.block_diag(*turn)
    return blocks @ out @ blocks.mT
