# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of velocity estimation: association with earlier boxes, the line fit, and the choice among candidates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import Boolx1, F32x1, F32x2, F64x1, F64x2, F64x3, I64x1, njit


class BoxColumns(NamedTuple):
    """N boxes: centres (N, 3), and of the current ones yaw (N,) and velocity (N, 2); position sigma (N,)."""

    center: F32x2
    sigma: F32x1


class PastColumns(NamedTuple):
    """Boxes of earlier frames, one after the other: those of frame k are rows start[k] to start[k + 1].

    motions: (K, 2, 4), rotation and translation to the current frame, of x and y. age_s: (K,).
    """

    boxes: BoxColumns
    start: I64x1
    motions: F64x3
    age_s: F64x1


class FitLimits(NamedTuple):
    """The numbers of a ``VelocityConfig`` that the fit needs."""

    gate_m: float
    sigma_position_m: float
    sigma_detected_velocity_mps: float
    sigma_lateral_velocity_mps: float


class LineFits(NamedTuple):
    """N lines through box positions. velocity: (N, 2) m/s; information: (N, 3), its inverse covariance, xx, xy, yy.

    associated: (N,), whether an earlier box was found.
    """

    velocity: F64x2
    information: F64x2
    associated: Boolx1


@njit(cache=True, nogil=True)
def fit_lines(
    boxes: BoxColumns, yaw: F32x1, detected: F32x2, past: PastColumns, limits: FitLimits
) -> LineFits:  # pragma: no cover
    """Associate boxes with earlier ones, newest first, and fit a line to the positions of each; detected: velocities (N, 2)."""
    n = len(yaw)
    prior, pull = _make_prior(yaw, detected, limits)
    # Sums over positions of w, w t, w t^2, of w p and of w t p: w is the inverse variance, p is relative to the current position.
    sums, moments = np.zeros((n, 3)), np.zeros((n, 2, 2))
    fit = LineFits(np.empty((n, 2)), np.empty((n, 3)), np.zeros(n, np.bool_))
    for i in range(n):
        sums[i, 0] = 1.0 / (limits.sigma_position_m**2 + boxes.sigma[i] ** 2)
        _solve(sums[i], moments[i], prior[i], pull[i], fit, i)
    for k in range(len(past.age_s)):
        first, t = past.start[k], -past.age_s[k]
        places = _move(past.boxes.center[first : past.start[k + 1]], past.motions[k])
        expected = np.empty((n, 2))
        for i in range(n):
            for axis in range(2):
                at = moments[i, 0, axis] / sums[i, 0] + fit.velocity[i, axis] * (t - sums[i, 1] / sums[i, 0])
                expected[i, axis] = boxes.center[i, axis] + at
        partner = _associate(expected, places, limits.gate_m)
        for i in range(n):
            if partner[i] < 0:
                continue
            fit.associated[i] = True
            weight = 1.0 / (limits.sigma_position_m**2 + past.boxes.sigma[first + partner[i]] ** 2)
            sums[i, 0] += weight
            sums[i, 1] += weight * t
            sums[i, 2] += weight * t * t
            for axis in range(2):
                distance = places[partner[i], axis] - boxes.center[i, axis]
                moments[i, 0, axis] += weight * distance
                moments[i, 1, axis] += weight * t * distance
            _solve(sums[i], moments[i], prior[i], pull[i], fit, i)
    return fit


@njit(cache=True, nogil=True)
def _make_prior(yaw: F32x1, detected: F32x2, limits: FitLimits) -> tuple[F64x2, F64x2]:  # pragma: no cover
    """Return the prior information (N, 3) of the velocity, and (N, 2), it times the mean."""
    prior, pull = np.empty((len(yaw), 3)), np.empty((len(yaw), 2))
    ahead, aside = limits.sigma_detected_velocity_mps**-2, limits.sigma_lateral_velocity_mps**-2
    for i in range(len(yaw)):
        c, s = np.cos(np.float64(yaw[i])), np.sin(np.float64(yaw[i]))
        prior[i, 0] = c * c * ahead + s * s * aside
        prior[i, 1] = c * s * (ahead - aside)
        prior[i, 2] = s * s * ahead + c * c * aside
        speed = (detected[i, 0] * c + detected[i, 1] * s) * ahead
        pull[i, 0], pull[i, 1] = speed * c, speed * s
    return prior, pull


@njit(cache=True, nogil=True)
def _solve(sums: F64x1, moments: F64x2, prior: F64x1, pull: F64x1, fit: LineFits, i: int) -> None:  # pragma: no cover
    """Write the information and the velocity of line i: the maximum a posteriori estimate."""
    spread = sums[2] - sums[1] * sums[1] / sums[0]
    xx, xy, yy = prior[0] + spread, prior[1], prior[2] + spread
    x = pull[0] + moments[1, 0] - moments[0, 0] * (sums[1] / sums[0])
    y = pull[1] + moments[1, 1] - moments[0, 1] * (sums[1] / sums[0])
    determinant = xx * yy - xy * xy
    fit.information[i, 0], fit.information[i, 1], fit.information[i, 2] = xx, xy, yy
    fit.velocity[i, 0], fit.velocity[i, 1] = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant


@njit(cache=True, nogil=True)
def _move(center: F32x2, motion: F64x2) -> F64x2:  # pragma: no cover
    """Return x and y (N, 2) of centres in the current frame."""
    moved = np.empty((len(center), 2))
    for i in range(len(center)):
        for axis in range(2):
            row = motion[axis]
            moved[i, axis] = row[0] * center[i, 0] + row[1] * center[i, 1] + row[2] * center[i, 2] + row[3]
    return moved


@njit(cache=True, nogil=True)
def _associate(expected: F64x2, places: F64x2, gate_m: float) -> I64x1:  # pragma: no cover
    """Return for each expected position (N, 2) the place (M, 2) that is its mutual nearest neighbour within the gate, else -1."""
    partner, nearest = np.full(len(expected), -1), np.full(len(places), -1)
    best, min_distance = np.full(len(expected), np.inf), np.full(len(places), np.inf)
    for i in range(len(expected)):
        for j in range(len(places)):
            dx, dy = places[j, 0] - expected[i, 0], places[j, 1] - expected[i, 1]
            d = dx * dx + dy * dy
            if d < best[i]:
                best[i], partner[i] = d, j
            if d < min_distance[j]:
                min_distance[j], nearest[j] = d, i
    for i in range(len(expected)):
        if partner[i] >= 0 and (nearest[partner[i]] != i or best[i] > gate_m * gate_m):
            partner[i] = -1
    return partner


@njit(cache=True, nogil=True)
def choose_candidates(fit: LineFits, yaw: F32x1, sigma: F64x1, sigmas: F64x1, cost: F64x2) -> None:  # pragma: no cover
    """Move each associated velocity along the vehicle's length to the candidate of minimum cost (N, S); sigma: (N,) m/s."""
    for i in range(len(yaw)):
        if fit.associated[i]:
            shift = sigma[i] * sigmas[np.argmin(cost[i])]
            fit.velocity[i, 0] += shift * np.cos(np.float64(yaw[i]))
            fit.velocity[i, 1] += shift * np.sin(np.float64(yaw[i]))


@njit(cache=True, nogil=True)
def longitudinal_sigmas(fit: LineFits, yaw: F32x1, max_sigma_mps: float) -> F64x1:  # pragma: no cover
    """Return (N,) standard deviations, m/s, of the velocity along the vehicle's length, at most max_sigma_mps."""
    sigma = np.empty(len(yaw))
    for i in range(len(yaw)):
        c, s = np.cos(np.float64(yaw[i])), np.sin(np.float64(yaw[i]))
        xx, xy, yy = fit.information[i]
        variance = (yy * c * c - 2.0 * xy * c * s + xx * s * s) / (xx * yy - xy * xy)
        sigma[i] = min(np.sqrt(variance), max_sigma_mps)
    return sigma


@njit(cache=True, nogil=True)
def significant_velocities(
    fit: LineFits, detected: F32x2, min_z_score: float, min_speed_mps: float
) -> F32x2:  # pragma: no cover
    """Return velocities (N, 2): 0 where insignificant, the detected ones (N, 2) where nothing was associated."""
    out = detected.copy()
    for i in range(len(out)):
        if fit.associated[i]:
            x, y = fit.velocity[i]
            xx, xy, yy = fit.information[i]
            significant = xx * x * x + 2.0 * xy * x * y + yy * y * y >= min_z_score**2
            moves = significant and x * x + y * y >= min_speed_mps**2
            out[i, 0], out[i, 1] = (x, y) if moves else (0.0, 0.0)
    return out


@njit(cache=True, nogil=True)
def nearest_boxes(places: F32x2, center: F32x2, max_distance_m: float) -> I64x1:  # pragma: no cover
    """Return for each place (T, 2) the row of the nearest of centres (N, 2 or more), the first of ties; N beyond the distance."""
    nearest = np.full(len(places), len(center))
    for i in range(len(places)):
        min_squared = np.float32(max_distance_m * max_distance_m)
        for j in range(len(center)):
            dx, dy = center[j, 0] - places[i, 0], center[j, 1] - places[i, 1]
            d = dx * dx + dy * dy
            if d < min_squared or (d == min_squared and nearest[i] == len(center)):
                min_squared, nearest[i] = d, j
    return nearest
