# SPDX-License-Identifier: Apache-2.0
"""Rigid coherent point drift in the plane (Myronenko and Song, IEEE TPAMI 32(12), 2010, Fig. 2), with or without scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, njit
from manyeyes.datatypes.map_element import freeze

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CpdConfig:
    """estimate_scale: whether a scale is estimated too; the paper's registration is without. outlier_fraction: w, the share of
    uniform noise.

    initial_sigma_m: start of the annealed sigma, metres; None: from the spread of both sets, as published. tolerance: of the change
    of sigma squared, square metres, at which it ends; max_iterations: at most. max_shift_m: a result that moves the mean of the
    points farther is refused (no motion); None: any.
    """

    estimate_scale: bool = False
    outlier_fraction: float = 0.0
    initial_sigma_m: float | None = None
    tolerance: float = 1e-5
    max_iterations: int = 100
    max_shift_m: float | None = None


class _Similarity(NamedTuple):
    """A similarity transform of the plane: scale, rotation by angle (rad), shift (m); and how many iterations it took."""

    scale: float
    angle: float
    shift_x: float
    shift_y: float
    num_iterations: int


@dataclass(frozen=True)
class CpdResult:
    """y to ``scale * y @ rotation.T + shift``; num_iterations: how many it took."""

    scale: float
    rotation: Floats
    shift: Floats
    num_iterations: int

    def apply(self, points: Floats) -> Floats:
        """Return (K, 2) points moved."""
        return self.scale * points @ self.rotation.T + self.shift


def register(target: Floats, source: Floats, config: CpdConfig = CpdConfig()) -> CpdResult:
    """Return the motion that brings source (M, 2) onto target (N, 2)."""
    # Relative to the target's mean: far from the origin the squares would lose precision.
    centre = target.mean(0)
    x, y = freeze(target - centre, np.float64), freeze(source - centre, np.float64)
    start = -1.0 if config.initial_sigma_m is None else config.initial_sigma_m**2
    fit = _run_cpd(x, y, config.estimate_scale, config.outlier_fraction, start, config.tolerance, config.max_iterations)
    c, s = np.cos(fit.angle), np.sin(fit.angle)
    rotation = np.array([[c, -s], [s, c]])
    shift = np.array([fit.shift_x, fit.shift_y]) + centre - fit.scale * rotation @ centre
    found = CpdResult(fit.scale, rotation, shift, fit.num_iterations)
    moved = found.apply(source).mean(0) - source.mean(0)
    if config.max_shift_m is not None and np.hypot(*moved) > config.max_shift_m:
        return CpdResult(1.0, np.eye(2), np.zeros(2), fit.num_iterations)
    return found


@njit(cache=True)
def _initial_variance(x: F64x2, y: F64x2) -> float:  # pragma: no cover - compiled
    """Compute sigma squared from the spread of both sets (N, 2) and (M, 2), as published."""
    n, m = len(x), len(y)
    variance = 0.0
    for i in range(n):
        for j in range(m):
            variance += (x[i, 0] - y[j, 0]) ** 2 + (x[i, 1] - y[j, 1]) ** 2
    return variance / (2.0 * n * m)


class _Moments(NamedTuple):
    """Sums over the posterior p(j | i): of itself, of x, of y, of their squares, and of their products across and along."""

    total: float
    sx: float
    sy: float
    tx: float
    ty: float
    xx: float
    yy: float
    cross_c: float
    cross_s: float


@njit(cache=True)
def _sum_posterior(
    x: F64x2, y: F64x2, motion: tuple[float, float, float, float, float], variance: float, uniform: float
) -> _Moments:  # pragma: no cover - compiled
    """Sum the posterior of all pairs under a motion: scale, cosine and sine of the rotation, shift."""
    scale, c, s, u, v = motion
    n, m = len(x), len(y)
    weight = np.empty(m)
    total, sx, sy, tx, ty = 0.0, 0.0, 0.0, 0.0, 0.0
    xx, yy, cross_c, cross_s = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        min_cost = np.inf
        for j in range(m):
            dx = x[i, 0] - scale * (c * y[j, 0] - s * y[j, 1]) - u
            dy = x[i, 1] - scale * (s * y[j, 0] + c * y[j, 1]) - v
            weight[j] = (dx * dx + dy * dy) / (2.0 * variance)
            min_cost = min(min_cost, weight[j])
        # Relative to the nearest, so that nothing underflows; what is e^40 times less likely is nothing.
        denominator = uniform * np.exp(min(min_cost, 700.0)) if uniform > 0.0 else 0.0
        mass, mx, my, mm = 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            if weight[j] - min_cost < 40.0:
                w = np.exp(min_cost - weight[j])
                mass += w
                mx += w * y[j, 0]
                my += w * y[j, 1]
                mm += w * (y[j, 0] ** 2 + y[j, 1] ** 2)
        denominator += mass
        p, mx, my = mass / denominator, mx / denominator, my / denominator
        total += p
        sx += p * x[i, 0]
        sy += p * x[i, 1]
        tx += mx
        ty += my
        xx += p * (x[i, 0] ** 2 + x[i, 1] ** 2)
        yy += mm / denominator
        cross_c += x[i, 0] * mx + x[i, 1] * my
        cross_s += x[i, 1] * mx - x[i, 0] * my
    return _Moments(total, sx, sy, tx, ty, xx, yy, cross_c, cross_s)


@njit(cache=True)
def _run_cpd(
    x: F64x2,
    y: F64x2,
    estimate_scale: bool,
    outlier_fraction: float,
    initial_variance: float,
    tolerance: float,
    max_iterations: int,
) -> _Similarity:  # pragma: no cover - compiled
    """Register y (M, 2) onto x (N, 2) by expectation maximization; initial_variance: sigma squared, negative: from the spread."""
    n, m = len(x), len(y)
    scale, c, s, u, v = 1.0, 1.0, 0.0, 0.0, 0.0
    variance = initial_variance
    if variance < 0.0:
        variance = _initial_variance(x, y)
    count = 0
    while count < max_iterations and variance > 1e-12:
        count += 1
        uniform = 2.0 * np.pi * variance * outlier_fraction / (1.0 - outlier_fraction) * m / n
        total, sx, sy, tx, ty, xx, yy, cross_c, cross_s = _sum_posterior(x, y, (scale, c, s, u, v), variance, uniform)
        if total <= 1e-12:
            break
        sx, sy, tx, ty = sx / total, sy / total, tx / total, ty / total
        xx -= total * (sx * sx + sy * sy)
        yy -= total * (tx * tx + ty * ty)
        cross_c -= total * (sx * tx + sy * ty)
        cross_s -= total * (sy * tx - sx * ty)
        # In the plane the best rotation is an angle: the SVD of the paper in closed form.
        length = np.hypot(cross_c, cross_s)
        c, s = (cross_c / length, cross_s / length) if length > 0.0 else (1.0, 0.0)
        scale = length / yy if estimate_scale and yy > 0.0 else 1.0
        u, v = sx - scale * (c * tx - s * ty), sy - scale * (s * tx + c * ty)
        before = variance
        variance = max((xx + scale * scale * yy - 2.0 * scale * length) / (2.0 * total), 0.0)
        if abs(before - variance) < tolerance:
            break
    return _Similarity(scale, np.arctan2(s, c), u, v, count)
