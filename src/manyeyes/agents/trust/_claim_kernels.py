# SPDX-License-Identifier: Apache-2.0
"""Compiled loop of ``claims``."""

from __future__ import annotations

import math

import numpy as np

from manyeyes._jit import F32x1, F32x2, F64x1, F64x2, njit
from manyeyes.models.detector._decode_kernels import DecodeLimits, RawColumns, decode_grid
from manyeyes.ops._sort_kernels import argsort


@njit(cache=True, nogil=True)
def place_claims(
    center: F64x2,
    size: F64x2,
    yaw: F64x1,
    velocity: F64x2,
    score: F64x1,
    sigma_xy: F64x1,
    rotation: F64x2,
    origin: F64x1,
    numbers: F64x1,
    max_claims: int,
) -> tuple[F64x2, F64x2, F64x1, F64x1, F64x2]:  # pragma: no cover
    """Return stated boxes (N) of a score, by falling score, in the ego's frame at its time, as columns of ``Claims``: columns,
    velocity, score, sigma_m and stated_xy; without those that are not finite.

    rotation (3, 3), origin (3,): of the sender in the ego's frame. numbers: the time by which boxes are moved, s; the variances of
    position (of both poses and of the motion since), m^2, and heading, rad^2; the minimum score.
    """
    seconds, variance_xy, variance_yaw, min_score = numbers
    order = argsort(-score)[:max_claims]
    columns, moved = np.empty((len(order), 7)), np.empty((len(order), 2))
    sigma_m, stated = np.empty(len(order)), np.empty((len(order), 2))
    scores, turn, count = np.empty(len(order)), math.atan2(rotation[1, 0], rotation[0, 0]), 0
    for row in order:
        if not score[row] >= min_score:
            continue
        x, y = center[row, 0] + velocity[row, 0] * seconds, center[row, 1] + velocity[row, 1] * seconds
        is_finite = True
        for k in range(3):
            columns[count, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * center[row, 2] + origin[k]
            columns[count, 3 + k] = size[row, k]
            is_finite &= math.isfinite(columns[count, k]) and math.isfinite(size[row, k])
        columns[count, 6] = yaw[row] + turn
        for k in range(2):
            moved[count, k] = rotation[k, 0] * velocity[row, 0] + rotation[k, 1] * velocity[row, 1]
            stated[count, k] = center[row, k]
        squared = center[row, 0] ** 2 + center[row, 1] ** 2
        sigma_m[count] = math.sqrt(variance_xy + variance_yaw * squared + sigma_xy[row] ** 2)
        scores[count] = score[row]
        if is_finite and math.isfinite(columns[count, 6]) and math.isfinite(sigma_m[count]):
            count += 1
    return columns[:count], moved[:count], scores[:count], sigma_m[:count], stated[:count]


@njit(cache=True, nogil=True)
def place_proposals(
    values: F32x2,
    xy: F32x2,
    heat: F32x1,
    cell_m: float,
    columns: RawColumns,
    limits: DecodeLimits,
    rotation: F64x2,
    origin: F64x1,
    numbers: F64x1,
    max_claims: int,
) -> tuple[F64x2, F64x2, F64x1, F64x1, F64x2]:  # pragma: no cover
    """Do the same with the boxes that tokens propose; the first arguments are those of ``decode_grid``."""
    found = decode_grid(values, xy, heat, cell_m, columns, limits)
    return place_claims(
        found.center.astype(np.float64),
        found.size.astype(np.float64),
        found.yaw.astype(np.float64),
        found.velocity.astype(np.float64),
        found.score.astype(np.float64),
        found.sigma_xy.astype(np.float64),
        rotation,
        origin,
        numbers,
        max_claims,
    )
