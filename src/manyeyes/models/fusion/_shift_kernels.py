# SPDX-License-Identifier: Apache-2.0
"""Loops of the shift of senders: peaks, pairs of them, and the pose error that makes the pairs most probable."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from manyeyes._jit import F64x1, F64x2, I64x1, njit


class ShiftSettings(NamedTuple):
    """Fields of ``sender_shift.ShiftConfig`` by the same names."""

    max_shift_m: float
    max_deviation: float
    min_sigma_m: float
    clutter_per_m2: float
    prior_sigma_m: float
    prior_sigma_yaw_rad: float
    apart_m: float
    max_second: float
    iterations: int


class Pairs(NamedTuple):
    """Pairs of a peak of the sender and one of the ego that could be one object.

    begin: (n + 1,) first pair of each peak of the sender. arm: (n, 2) from the sender to its peaks, metres. away: (m, 2) from the
    sender's peak to the ego's, metres. variance: (m,) of each axis of it, square metres. strength: (m,) in 0 to 1, of both peaks.
    """

    begin: I64x1
    arm: F64x2
    away: F64x2
    variance: F64x1
    strength: F64x1


@njit(cache=True, nogil=True)
def pick_peaks(xy: F64x2, order: I64x1, radius_m: float, row: I64x1) -> int:  # pragma: no cover
    """Fill row with the tokens of order that lie farther than the radius from all before them; returns their number.

    xy: (n, 2), metres.
    """
    count = 0
    for place in range(order.shape[0]):
        i = order[place]
        is_peak = True
        for k in range(count):
            dx, dy = xy[i, 0] - xy[row[k], 0], xy[i, 1] - xy[row[k], 1]
            if dx * dx + dy * dy <= radius_m * radius_m:
                is_peak = False
                break
        if is_peak:
            row[count] = i
            count += 1
            if count == row.shape[0]:
                break
    return count


@njit(cache=True, nogil=True)
def list_pairs(  # pragma: no cover
    ego_xy: F64x2,
    ego_sigma: F64x1,
    ego_weight: F64x1,
    xy: F64x2,
    sigma: F64x1,
    weight: F64x1,
    origin: F64x1,
    settings: ShiftSettings,
) -> Pairs:
    """List the pairs of peaks not farther apart than twice the largest shift. ego_xy, xy: (m, 2) and (n, 2), metres."""
    reach = 2 * settings.max_shift_m
    capacity = xy.shape[0] * ego_xy.shape[0]
    begin, arm = np.zeros(xy.shape[0] + 1, np.int64), np.empty((xy.shape[0], 2))
    away, variance, strength = np.empty((capacity, 2)), np.empty(capacity), np.empty(capacity)
    count = 0
    for i in range(xy.shape[0]):
        arm[i, 0], arm[i, 1] = xy[i, 0] - origin[0], xy[i, 1] - origin[1]
        for j in range(ego_xy.shape[0]):
            dx, dy = ego_xy[j, 0] - xy[i, 0], ego_xy[j, 1] - xy[i, 1]
            if dx * dx + dy * dy <= reach * reach:
                away[count, 0], away[count, 1] = dx, dy
                variance[count] = sigma[i] ** 2 + ego_sigma[j] ** 2 + settings.min_sigma_m**2
                strength[count] = math.sqrt(ego_weight[j] * weight[i])
                count += 1
        begin[i + 1] = count
    return Pairs(begin, arm, away[:count], variance[:count], strength[:count])


@njit(cache=True, nogil=True)
def find_log_likelihood(  # pragma: no cover
    pairs: Pairs, x: float, y: float, yaw: float, sigma_yaw: float, settings: ShiftSettings
) -> float:
    """Return how much more probable the sender's peaks are by the ego's, at an error x, y [m], yaw [rad], than as clutter; log.

    sigma_yaw: what the error of the heading may differ from yaw, radians.
    """
    total = 0.0
    for i in range(pairs.arm.shape[0]):
        arm_x, arm_y = pairs.arm[i, 0], pairs.arm[i, 1]
        expected_x, expected_y = x - yaw * arm_y, y + yaw * arm_x
        turn = sigma_yaw * sigma_yaw * (arm_x * arm_x + arm_y * arm_y) / 2
        density = 0.0
        for k in range(pairs.begin[i], pairs.begin[i + 1]):
            density += _find_density(pairs, k, expected_x, expected_y, turn, settings)
        total += math.log(1 + density / settings.clutter_per_m2)
    return total


@njit(cache=True, nogil=True)
def _find_density(  # pragma: no cover
    pairs: Pairs, k: int, x: float, y: float, more: float, settings: ShiftSettings
) -> float:
    """Return the density per square metre of pair k at an expected displacement; more: variance to add."""
    dx, dy = pairs.away[k, 0] - x, pairs.away[k, 1] - y
    variance = pairs.variance[k] + more
    square = (dx * dx + dy * dy) / variance
    if square > settings.max_deviation * settings.max_deviation:
        return 0.0
    return pairs.strength[k] * math.exp(-square / 2) / (2 * math.pi * variance)


@njit(cache=True, nogil=True)
def find_start(pairs: Pairs, settings: ShiftSettings, start: F64x1) -> bool:  # pragma: no cover
    """Fill start (2,) with the displacement at which the peaks are most probable under the prior, whatever the heading.

    Candidates are no displacement and those of pairs. Returns whether it is the only one: no candidate apart from it explains
    almost as many peaks.
    """
    count = pairs.away.shape[0]
    found = np.full(count + 1, -np.inf)
    best = 0
    for c in range(count + 1):
        x, y = (pairs.away[c - 1, 0], pairs.away[c - 1, 1]) if c > 0 else (0.0, 0.0)
        square = x * x + y * y
        if square > settings.max_shift_m * settings.max_shift_m:
            continue
        found[c] = find_log_likelihood(pairs, x, y, 0.0, settings.prior_sigma_yaw_rad, settings)
        found[c] -= square / (2 * settings.prior_sigma_m * settings.prior_sigma_m)
        if found[c] > found[best]:
            best = c
    start[0], start[1] = (pairs.away[best - 1, 0], pairs.away[best - 1, 1]) if best > 0 else (0.0, 0.0)
    threshold = found[best] * settings.max_second
    for c in range(count + 1):
        x, y = (pairs.away[c - 1, 0], pairs.away[c - 1, 1]) if c > 0 else (0.0, 0.0)
        square = (x - start[0]) * (x - start[0]) + (y - start[1]) * (y - start[1])
        if found[c] > threshold and square > settings.apart_m * settings.apart_m:
            return False
    return True


@njit(cache=True, nogil=True)
def solve_pairs(  # pragma: no cover
    pairs: Pairs, settings: ShiftSettings, estimate: F64x1, covariance: F64x2
) -> float:
    """Improve the estimate (3,) of x, y, yaw by expectation maximization, and fill its covariance (3, 3).

    Each step is least squares with a Gaussian prior; a pair weighs as much as it is probable. Returns the sum of the probabilities.
    """
    prior_xy, prior_yaw = 1 / settings.prior_sigma_m**2, 1 / settings.prior_sigma_yaw_rad**2
    number = 0.0
    for _ in range(settings.iterations):
        number, total, sum_x, sum_y, square, x, y, turn = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(pairs.arm.shape[0]):
            arm_x, arm_y = pairs.arm[i, 0], pairs.arm[i, 1]
            expected_x, expected_y = estimate[0] - estimate[2] * arm_y, estimate[1] + estimate[2] * arm_x
            density = settings.clutter_per_m2
            for k in range(pairs.begin[i], pairs.begin[i + 1]):
                density += _find_density(pairs, k, expected_x, expected_y, 0.0, settings)
            for k in range(pairs.begin[i], pairs.begin[i + 1]):
                share = _find_density(pairs, k, expected_x, expected_y, 0.0, settings) / density
                scale = share / pairs.variance[k]
                away_x, away_y = pairs.away[k, 0], pairs.away[k, 1]
                number += share
                total += scale
                sum_x += scale * arm_x
                sum_y += scale * arm_y
                square += scale * (arm_x * arm_x + arm_y * arm_y)
                x += scale * away_x
                y += scale * away_y
                turn += scale * (arm_x * away_y - arm_y * away_x)
        # The normal matrix is [[a, 0, -sum_y], [0, a, sum_x], [-sum_y, sum_x, c]].
        a, c = total + prior_xy, square + prior_yaw
        left = c - (sum_x * sum_x + sum_y * sum_y) / a
        estimate[2] = (turn + (sum_y * x - sum_x * y) / a) / left
        estimate[0] = (x + sum_y * estimate[2]) / a
        estimate[1] = (y - sum_x * estimate[2]) / a
        covariance[2, 2] = 1 / left
        covariance[0, 2] = covariance[2, 0] = sum_y / a / left
        covariance[1, 2] = covariance[2, 1] = -sum_x / a / left
        covariance[0, 0] = 1 / a + sum_y * sum_y / (a * a) / left
        covariance[1, 1] = 1 / a + sum_x * sum_x / (a * a) / left
        covariance[0, 1] = covariance[1, 0] = -sum_x * sum_y / (a * a) / left
    return number
