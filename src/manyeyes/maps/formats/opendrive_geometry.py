# SPDX-License-Identifier: Apache-2.0
"""The curves of OpenDRIVE 1.4: piecewise cubics over s and the plan view's primitives (ASAM OpenDRIVE 1.4H, §5.3)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(8)
_SPIRAL_PANELS = 16
_ARC_LENGTH_STEPS_PER_M = 8


@dataclass(frozen=True, eq=False)
class Cubics:
    """Piecewise a + b d + c d^2 + e d^3 with d = s - start; start: (K,) ascending, coefficients: (K, 4)."""

    start: Array
    coefficients: Array

    @classmethod
    def constant(cls, value: float) -> Cubics:
        """Return the same value everywhere."""
        return cls(np.zeros(1), np.array([[value, 0.0, 0.0, 0.0]]))

    def __call__(self, s: Array) -> Array:
        """Return values at stations (M,); the first piece also holds before its start."""
        index = np.clip(np.searchsorted(self.start, s + 1e-9, side="right") - 1, 0, None)
        d = s - self.start[index]
        a, b, c, e = self.coefficients[index].T
        return a + d * (b + d * (c + d * e))


@dataclass(frozen=True, eq=False)
class Primitive:
    """One piece of a reference line, starting at station s with the pose x, y, heading.

    kind: line, arc, spiral, poly3 or paramPoly3. parameters: none; curvature; start and end curvature; a…d;
    aU…dU, aV…dV and 1.0 where the parameter runs over 0…1 instead of over metres.
    """

    s: float
    x: float
    y: float
    heading: float
    length: float
    kind: str
    parameters: tuple[float, ...]

    @property
    def tightest_radius_m(self) -> float:
        """The smallest radius of curvature that the sampling has to follow; an estimate for polynomials."""
        if self.kind == "line":
            return np.inf
        if self.kind in ("arc", "spiral"):
            sharpest = max(abs(p) for p in self.parameters)
            return 1.0 / sharpest if sharpest > 1e-9 else np.inf
        return 0.0

    def evaluate(self, s: Array) -> tuple[Array, Array, Array]:
        """x, y, heading (M,) at stations s (M,) of the road."""
        u, v, turn = _LOCAL[self.kind](s - self.s, self)
        c, n = np.cos(self.heading), np.sin(self.heading)
        return self.x + c * u - n * v, self.y + n * u + c * v, self.heading + turn


def _line(d: Array, piece: Primitive) -> tuple[Array, Array, Array]:
    return d, np.zeros_like(d), np.zeros_like(d)


def _arc(d: Array, piece: Primitive) -> tuple[Array, Array, Array]:
    (curvature,) = piece.parameters
    if abs(curvature) < 1e-12:
        return _line(d, piece)
    turn = curvature * d
    return np.sin(turn) / curvature, (1.0 - np.cos(turn)) / curvature, turn


def _spiral(d: Array, piece: Primitive) -> tuple[Array, Array, Array]:
    """Clothoid by Gauss-Legendre quadrature of its heading: exact to rounding for every road that can be driven."""
    start, end = piece.parameters
    rate = (end - start) / piece.length if piece.length else 0.0
    edges = np.arange(_SPIRAL_PANELS) / _SPIRAL_PANELS
    nodes = (edges[:, None] + (_GAUSS_NODES + 1.0) / (2 * _SPIRAL_PANELS)).ravel()
    weights = np.tile(_GAUSS_WEIGHTS / (2 * _SPIRAL_PANELS), _SPIRAL_PANELS)
    along = d[:, None] * nodes
    turn = along * (start + rate / 2 * along)
    return d * (np.cos(turn) @ weights), d * (np.sin(turn) @ weights), d * (start + rate / 2 * d)


def _poly3(d: Array, piece: Primitive) -> tuple[Array, Array, Array]:
    """v = a + b u + c u^2 + d u^3; u is found from the arc length by interpolation in a fine table."""
    a, b, c, e = piece.parameters
    table = np.linspace(0.0, piece.length, max(64, int(piece.length * _ARC_LENGTH_STEPS_PER_M)) + 1)
    slope = b + table * (2 * c + table * 3 * e)
    speed = np.hypot(1.0, slope)
    length = np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(table))))
    u = np.interp(d, length, table)
    return u, a + u * (b + u * (c + u * e)), np.arctan(b + u * (2 * c + u * 3 * e))


def _param_poly3(d: Array, piece: Primitive) -> tuple[Array, Array, Array]:
    au, bu, cu, du, av, bv, cv, dv, normalised = piece.parameters
    p = d / piece.length if normalised else d
    u, v = au + p * (bu + p * (cu + p * du)), av + p * (bv + p * (cv + p * dv))
    return u, v, np.arctan2(bv + p * (2 * cv + p * 3 * dv), bu + p * (2 * cu + p * 3 * du))


_LOCAL = {"line": _line, "arc": _arc, "spiral": _spiral, "poly3": _poly3, "paramPoly3": _param_poly3}


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """A road's reference line with its heights: (s, t) to the world."""

    pieces: tuple[Primitive, ...]
    elevation: Cubics
    superelevation: Cubics
    length: float

    def pose(self, s: Array) -> tuple[Array, Array, Array]:
        """x, y, heading (M,) of the line at stations (M,)."""
        starts = np.array([piece.s for piece in self.pieces])
        index = np.clip(np.searchsorted(starts, s + 1e-9, side="right") - 1, 0, None)
        x, y, heading = np.empty_like(s), np.empty_like(s), np.empty_like(s)
        for k in np.unique(index):
            of_piece = index == k
            x[of_piece], y[of_piece], heading[of_piece] = self.pieces[k].evaluate(s[of_piece])
        return x, y, heading

    def points(self, s: Array, t: Array) -> Array:
        """Return world points (M, 3) at stations s and lateral offsets t (M,), left positive."""
        x, y, heading = self.pose(s)
        bank = self.superelevation(s)
        across = t * np.cos(bank)
        z = self.elevation(s) + t * np.sin(bank)
        return np.stack((x - np.sin(heading) * across, y + np.cos(heading) * across, z), -1)

    def stations(self, start: float, end: float, step_m: float, tight_step_m: float, extra: Array) -> Array:
        """Where to sample [start, end]: at every break, at ``extra``, and between them evenly at most a step apart.

        Curves tighter than 25 m (and polynomials) use tight_step_m: the chord then stays within 2 mm of the curve.
        """
        breaks = np.concatenate(([start, end], [p.s for p in self.pieces], self.elevation.start, extra))
        breaks = np.unique(breaks[(breaks >= start) & (breaks <= end)])
        breaks = breaks[np.concatenate(([True], np.diff(breaks) > 1e-4))]
        if breaks[-1] != end:
            breaks[-1] = end
        starts = np.array([p.s for p in self.pieces])
        parts = []
        for low, high in itertools.pairwise(breaks):
            piece = self.pieces[max(int(np.searchsorted(starts, (low + high) / 2, side="right")) - 1, 0)]
            step = tight_step_m if piece.tightest_radius_m < 25.0 else step_m
            parts.append(np.linspace(low, high, max(1, int(np.ceil((high - low) / step))) + 1)[:-1])
        return np.concatenate((*parts, [end]))
