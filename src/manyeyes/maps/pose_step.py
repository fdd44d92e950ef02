# SPDX-License-Identifier: Apache-2.0
"""One damped Gauss-Newton step of each observation's rigid motion towards lines near its own, held back by its claim.

Stage 2 of specs/maps.md 3.4: residuals count across lines only, along the mean normal of both lines, which has no bias on a
bend; each point has at most one vote; the prior is the claimed pose, less what its drive is known to be off.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.kernels import njit
from manyeyes.maps.associate import span
from manyeyes.maps.sightings import Sightings

if TYPE_CHECKING:
    from manyeyes.maps.align import AlignConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, nogil=True)
def normal_equations(home, own, others, numbers):  # pragma: no cover - compiled
    """Normal equations of each home observation: (H, 11) pivot x, y; information xx, xy, xt, yy, yt, tt; right side is
    last of (H, 14): then x, y, t of the gradient, residual sum, vote sum, points.
    """
    first, xy, tangent, kind, sigma = own
    keys, start, rxy, rtangent, robservation, rweight = others
    gate, kernel, reach, cosine, scatter, correlation = numbers
    out = np.zeros((len(home), 13))
    c2 = kernel * kernel
    for h in range(len(home)):
        o = home[h]
        a, b = first[o], first[o + 1]
        if a == b:
            continue
        px, py = xy[a:b, 0].mean(), xy[a:b, 1].mean()
        out[h, 0], out[h, 1] = px, py
        for p in range(a, b):
            x, y, u, v = xy[p, 0], xy[p, 1], tangent[p, 0], tangent[p, 1]
            ix, iy = int(np.floor(x / 2.5)), int(np.floor(y / 2.5))
            total, pull, square = 0.0, 0.0, 0.0
            for dx in range(-1, 2):
                low, high = span(keys, start, kind[p], ix + dx, iy - 1, iy + 1)
                for q in range(low, high):
                    ex, ey = rxy[q, 0] - x, rxy[q, 1] - y
                    if ex * ex + ey * ey > gate * gate + reach * reach or robservation[q] == o:
                        continue
                    dot = u * rtangent[q, 0] + v * rtangent[q, 1]
                    if abs(dot) < cosine:
                        continue
                    sign = 1.0 if dot > 0.0 else -1.0
                    norm = np.sqrt(2.0 + 2.0 * abs(dot))
                    mx, my = (u + sign * rtangent[q, 0]) / norm, (v + sign * rtangent[q, 1]) / norm
                    along, aside = abs(ex * mx + ey * my), ey * mx - ex * my
                    if along > reach or abs(aside) > gate:
                        continue
                    g = c2 / (c2 + aside * aside)
                    w = rweight[q] * g * g * (1.0 - along / reach)
                    total += w
                    pull += w * aside
                    square += w * aside * aside
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
            out[h, 11] += vote * aside * aside
            out[h, 12] += vote
    return out


def step_poses(
    sightings: Sightings, home: Ints, at: tuple[Floats, Floats, Floats], sums: Floats, config: AlignConfig
) -> dict[str, Floats]:
    """The columns of an Alignment that a sweep changes, for the home rows; at: start, lean and pose (O, 3) of all."""
    start, lean, pose = at
    prior = np.asarray(sightings.covariance)[home]
    pivot, now, begin = sums[:, :2], pose[home], start[home]
    jacobian = np.tile(np.eye(3), (len(home), 1, 1))
    jacobian[:, 0, 2] = -(now[:, 1] - pivot[:, 1])
    jacobian[:, 1, 2] = now[:, 0] - pivot[:, 0]
    information = sums[:, [2, 3, 4, 3, 5, 6, 4, 6, 7]].reshape(-1, 3, 3)
    gradient = sums[:, 8:11]
    moved = now - begin
    moved[:, 2] = (moved[:, 2] + np.pi) % (2 * np.pi) - np.pi
    off = moved - lean[home]
    # In units in which the prior is a unit ball the data's information tells directly how much it adds to the prior.
    inverse = np.linalg.inv(jacobian)
    root = np.linalg.cholesky(inverse @ prior @ inverse.transpose(0, 2, 1))
    root_t = root.transpose(0, 2, 1)
    strength, axes = np.linalg.eigh(root_t @ information @ root)
    strength = np.maximum(strength, 0.0)
    axes_t = axes.transpose(0, 2, 1)
    speaks = 1.0 / (1.0 + strength) <= config.frozen_above
    weighted = np.linalg.solve(prior, off[:, :, None])[:, :, 0]
    distance = np.einsum("oi,oi->o", off, weighted)
    trust = (config.prior_scale**2 / (config.prior_scale**2 + distance)) ** 2
    pull = _apply(axes_t, _apply(root_t, gradient)) * speaks
    back = _apply(axes_t, _apply(root_t, _apply(jacobian.transpose(0, 2, 1), weighted))) * trust[:, None]
    step = _apply(root, _apply(axes, (pull - back) / (strength * speaks + trust[:, None]))) * config.damping
    step = np.clip(step, (-1.0, -1.0, -0.05), (1.0, 1.0, 0.05))
    step[np.asarray(sightings.trusted)[home]] = 0.0
    c, s = np.cos(step[:, 2]), np.sin(step[:, 2])
    ax, ay = (now[:, :2] - pivot).T
    after = np.stack(
        (
            pivot[:, 0] + c * ax - s * ay + step[:, 0],
            pivot[:, 1] + s * ax + c * ay + step[:, 1],
            now[:, 2] + step[:, 2],
        ),
        1,
    )
    spread = jacobian @ root @ axes
    covariance = (spread / (1.0 + strength * speaks)[:, None, :]) @ spread.transpose(0, 2, 1)
    outward = np.linalg.inv(spread).transpose(0, 2, 1)
    heard = (outward * (strength * speaks)[:, None, :]) @ outward.transpose(0, 2, 1)
    return {
        "pose": after,
        "covariance": (covariance + covariance.transpose(0, 2, 1)) / 2,
        "observability": np.sort(strength * speaks / (1.0 + strength), axis=1),
        "heard": heard,
        "urge": _apply(heard, moved) + _apply(outward, pull),
        "residual": sums[:, 11],
        "matched": sums[:, 12],
    }


def _apply(matrix: NDArray, vector: NDArray) -> Floats:
    return np.einsum("oij,oj->oi", matrix, vector)
