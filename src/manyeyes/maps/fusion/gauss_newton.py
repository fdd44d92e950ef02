# SPDX-License-Identifier: Apache-2.0
"""One damped Gauss-Newton step of each observation's pose on point-to-line residuals, with a pose prior.

Residuals are lateral, along the mean normal of both lines, which has no bias on a bend. Each point has a total weight of at
most one. It aligns one observation to a fixed map (:mod:`manyeyes.maps.fusion.incremental`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, F64x3, I64x1, njit, set_rows
from manyeyes.maps.fusion.observation_arrays import ObservationArrays
from manyeyes.maps.fusion.point_grid import find_cell_range, line_residual

if TYPE_CHECKING:
    from manyeyes.maps.fusion.pose_config import PoseSolverConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_OwnPoints = tuple[I64x1, F64x2, F64x2, I64x1, F64x1]
"""offsets, xy, tangent, kind, sigma."""
_OtherPoints = tuple[float, I64x1, I64x1, F64x2, F64x2, I64x1, F64x1]
"""cell size, keys, offsets, xy, tangent, observation, weight."""
_SolverParams = tuple[float, float, float, float, float, float]
"""lateral gate, kernel, longitudinal gate, cosine of the heading gate, sigma, points per independent one."""


@njit(cache=True, nogil=True)
def build_normal_equations(
    home: I64x1, own_points: _OwnPoints, other_points: _OtherPoints, params: _SolverParams
) -> F64x2:  # pragma: no cover - compiled
    """Build the normal equations (H, 11) of the home observations.

    Columns: pivot x, y; information xx, xy, xt, yy, yt, tt; right side x, y, t.
    """
    first, xy, tangent, kind, sigma = own_points
    cell, keys, start, rxy, rtangent, robservation, rweight = other_points
    gate, kernel, reach, cosine, scatter, correlation = params
    out = np.zeros((len(home), 11))
    c2, far = kernel * kernel, gate * gate + reach * reach
    radius, shorter = np.sqrt(far), 1.0 / reach
    for h in range(len(home)):
        o = home[h]
        a, b = first[o], first[o + 1]
        if a == b:
            continue
        px, py = xy[a:b, 0].mean(), xy[a:b, 1].mean()
        out[h, 0], out[h, 1] = px, py
        for p in range(a, b):
            x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
            lowest, highest = int(np.floor((y - radius) / cell)), int(np.floor((y + radius) / cell))
            total, pull = 0.0, 0.0
            for ix in range(int(np.floor((x - radius) / cell)), int(np.floor((x + radius) / cell)) + 1):
                low, high = find_cell_range(keys, start, kind[p], ix, lowest, highest)
                for q in range(low, high):
                    ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
                    if ex * ex + ey * ey > far or robservation[q] == o:
                        continue
                    along, aside = line_residual(ex, ey, u, v, rtangent[q, 0], rtangent[q, 1], cosine, True)
                    along = abs(along)
                    if along > reach or abs(aside) > gate:
                        continue
                    g = c2 / (c2 + aside * aside)
                    w = rweight[q] * g * g * (1.0 - along * shorter)
                    total += w
                    pull += w * aside
            if total <= 0.0:
                continue
            vote = total / (total + 0.5)
            aside = pull / total
            w = vote / (correlation * (sigma[p] * sigma[p] + scatter * scatter))
            jx, jy = -v, u
            jt = -jx * (y - py) + jy * (x - px)
            out[h, 2] += w * jx * jx
            out[h, 3] += w * jx * jy
            out[h, 4] += w * jx * jt
            out[h, 5] += w * jy * jy
            out[h, 6] += w * jy * jt
            out[h, 7] += w * jt * jt
            out[h, 8] += w * jx * aside
            out[h, 9] += w * jy * aside
            out[h, 10] += w * jt * aside
    return out


def step_poses(
    arrays: ObservationArrays, home: Ints, states: tuple[Floats, Floats], normal_sums: Floats, config: PoseSolverConfig
) -> tuple[Floats, Floats]:
    """Step the home rows: poses (H, 3) and their covariances (H, 3, 3).

    states: initial pose and pose (O, 3) of all observations. normal_sums: (H, 11) of :func:`build_normal_equations`.
    """
    start, pose = (np.ascontiguousarray(rows[home]) for rows in states)
    prior = np.ascontiguousarray(np.asarray(arrays.covariance)[home])
    params = (config.max_variance_ratio, config.align_prior_scale, config.damping)
    return _step_all(normal_sums, start, pose, prior, np.asarray(arrays.trusted)[home], params)


@njit(cache=True, nogil=True)
def _step_all(
    normal_sums: F64x2,
    start: F64x2,
    pose: F64x2,
    prior: F64x3,
    trusted: Boolx1,
    params: tuple[float, float, float],
) -> tuple[F64x2, F64x3]:  # pragma: no cover - compiled
    """Solve the damped step of each home observation.

    Returns poses (H, 3) and covariances (H, 3, 3).
    """
    max_variance_ratio, prior_scale, damping = params
    count = len(normal_sums)
    next_pose, covariance = np.empty((count, 3)), np.empty((count, 3, 3))
    jacobian, information = np.eye(3), np.empty((3, 3))
    limit = np.array([1.0, 1.0, 0.05])
    for h in range(count):
        px, py = normal_sums[h, 0], normal_sums[h, 1]
        jacobian[0, 2], jacobian[1, 2] = -(pose[h, 1] - py), pose[h, 0] - px
        k = 2
        for i in range(3):
            for j in range(i, 3):
                information[i, j] = information[j, i] = normal_sums[h, k]
                k += 1
        moved = pose[h] - start[h]
        moved[2] = (moved[2] + np.pi) % (2 * np.pi) - np.pi
        # Whitened by the prior, the eigenvalues of the information are ratios of prior to data variance.
        inverse = np.linalg.inv(jacobian)
        root = np.linalg.cholesky(inverse @ prior[h] @ inverse.T)
        strength, axes = np.linalg.eigh(root.T @ information @ root)
        strength = np.maximum(strength, 0.0)
        observed_strength = np.where(1.0 / (1.0 + strength) <= max_variance_ratio, strength, 0.0)
        weighted = np.linalg.solve(prior[h], moved)
        distance = np.sum(moved * weighted)
        trust = (prior_scale**2 / (prior_scale**2 + distance)) ** 2
        pull = axes.T @ (root.T @ normal_sums[h, 8:11])
        for i in range(3):
            if observed_strength[i] <= 0.0:
                pull[i] = 0.0
        back = axes.T @ (root.T @ (jacobian.T @ weighted)) * trust
        step = root @ (axes @ ((pull - back) / (observed_strength + trust))) * damping
        step = np.minimum(np.maximum(step, -limit), limit)
        if trusted[h]:
            step[:] = 0.0
        c, s = np.cos(step[2]), np.sin(step[2])
        ax, ay = pose[h, 0] - px, pose[h, 1] - py
        next_pose[h, 0], next_pose[h, 1] = px + c * ax - s * ay + step[0], py + s * ax + c * ay + step[1]
        next_pose[h, 2] = pose[h, 2] + step[2]
        spread = jacobian @ root @ axes
        narrow = (spread / (1.0 + observed_strength)) @ spread.T
        set_rows(covariance[h], (narrow + narrow.T) / 2)
    return next_pose, covariance
