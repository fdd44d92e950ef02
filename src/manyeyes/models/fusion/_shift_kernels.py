# SPDX-License-Identifier: Apache-2.0
"""Loops of the shift of senders: peaks, votes for a displacement, and least squares over its pairs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from manyeyes._jit import F64x1, F64x2, I64x1, njit


class ShiftSettings(NamedTuple):
    """Fields of ``sender_shift.ShiftConfig`` by the same names."""

    max_shift_m: float
    min_pairs: int
    vote_m: float
    match_m: float
    max_second: float
    prior_sigma_m: float
    prior_sigma_yaw_rad: float


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
def find_mode(  # pragma: no cover
    ego_xy: F64x2, ego_weight: F64x1, xy: F64x2, weight: F64x1, settings: ShiftSettings, mode: F64x1
) -> bool:
    """Fill mode (2,) with the displacement from a sender's peaks to the ego's that has the best vote; returns whether there is one.

    Each peak of the sender votes once for a displacement: by the nearest of its pairs. There is no mode with too few voters, or
    where another displacement, apart from it, has almost as many votes. ego_xy, xy: (m, 2) and (n, 2), metres.
    """
    max_shift_m, vote_m, prior_sigma_m = settings.max_shift_m, settings.vote_m, settings.prior_sigma_m
    capacity = xy.shape[0] * ego_xy.shape[0] + 1
    away, strength = np.zeros((capacity, 2)), np.zeros(capacity)
    begin = np.empty(xy.shape[0] + 1, np.int64)
    # Entry 0 is no displacement; the pairs of sender peak i are begin[i] to begin[i + 1].
    count, voters = 1, 0
    for i in range(xy.shape[0]):
        begin[i] = count
        for j in range(ego_xy.shape[0]):
            dx, dy = ego_xy[j, 0] - xy[i, 0], ego_xy[j, 1] - xy[i, 1]
            if dx * dx + dy * dy <= max_shift_m * max_shift_m:
                away[count, 0], away[count, 1] = dx, dy
                strength[count] = math.sqrt(ego_weight[j] * weight[i])
                count += 1
        voters += count > begin[i]
    begin[xy.shape[0]] = count
    if voters < settings.min_pairs:
        return False
    votes, best = np.zeros(count), 0
    for c in range(count):
        x, y = away[c, 0], away[c, 1]
        for i in range(xy.shape[0]):
            vote = 0.0
            for k in range(begin[i], begin[i + 1]):
                dx, dy = x - away[k, 0], y - away[k, 1]
                vote = max(vote, strength[k] * math.exp(-(dx * dx + dy * dy) / (2 * vote_m * vote_m)))
            votes[c] += vote
        votes[c] *= math.exp(-(x * x + y * y) / (8 * prior_sigma_m * prior_sigma_m))
        if votes[c] > votes[best]:
            best = c
    for c in range(count):
        dx, dy = away[c, 0] - away[best, 0], away[c, 1] - away[best, 1]
        if dx * dx + dy * dy > 4 * settings.match_m * settings.match_m and votes[c] > settings.max_second * votes[best]:
            return False
    # The mean of the pairs that vote for the mode.
    x, y = away[best, 0], away[best, 1]
    for _ in range(3):
        total, sum_x, sum_y = 0.0, 0.0, 0.0
        for k in range(1, count):
            dx, dy = away[k, 0] - x, away[k, 1] - y
            share = strength[k] * math.exp(-(dx * dx + dy * dy) / (2 * vote_m * vote_m))
            total += share
            sum_x += share * away[k, 0]
            sum_y += share * away[k, 1]
        x, y = sum_x / max(total, 1e-9), sum_y / max(total, 1e-9)
    mode[0], mode[1] = x, y
    return True


@njit(cache=True, nogil=True)
def match_peaks(
    ego_xy: F64x2, xy: F64x2, mode: F64x1, settings: ShiftSettings, partner: I64x1
) -> int:  # pragma: no cover
    """Fill partner (n,) with the ego's peak of each of the sender's, -1 for none; returns the number of pairs.

    Pairs are the nearest of each other at the displacement mode (2,). ego_xy, xy: (m, 2) and (n, 2), metres.
    """
    max_shift_m, match_m = settings.max_shift_m, settings.match_m
    nearest, shortest = np.full(ego_xy.shape[0], -1), np.full(ego_xy.shape[0], np.inf)
    square = np.full(xy.shape[0], np.inf)
    for i in range(xy.shape[0]):
        partner[i] = -1
        for j in range(ego_xy.shape[0]):
            dx, dy = ego_xy[j, 0] - xy[i, 0], ego_xy[j, 1] - xy[i, 1]
            if dx * dx + dy * dy <= max_shift_m * max_shift_m:
                distance = (dx - mode[0]) * (dx - mode[0]) + (dy - mode[1]) * (dy - mode[1])
                if distance < square[i]:
                    square[i], partner[i] = distance, j
                if distance < shortest[j]:
                    shortest[j], nearest[j] = distance, i
    pairs = 0
    for i in range(xy.shape[0]):
        if partner[i] >= 0 and (nearest[partner[i]] != i or square[i] > match_m * match_m):
            partner[i] = -1
        pairs += partner[i] >= 0
    return pairs


@njit(cache=True, nogil=True)
def solve_pairs(  # pragma: no cover
    arm: F64x2, measured: F64x2, precision: F64x1, settings: ShiftSettings, estimate: F64x1, covariance: F64x2
) -> float:
    """Fill estimate (3,) of x, y, yaw and covariance (3, 3) by least squares with Cauchy weights and a prior; returns its chi2.

    chi2: the part of the evidence against no error at all that the estimate explains. arm: (n, 2) places from the sender,
    measured: (n, 2) displacements, metres; precision: (n,) inverse variances.
    """
    prior_xy, prior_yaw = 1 / settings.prior_sigma_m**2, 1 / settings.prior_sigma_yaw_rad**2
    robust = np.ones(arm.shape[0])
    chi2 = 0.0
    for _ in range(4):
        total, sum_x, sum_y, square, x, y, turn = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(arm.shape[0]):
            scale = precision[k] * robust[k]
            total += scale
            sum_x += scale * arm[k, 0]
            sum_y += scale * arm[k, 1]
            square += scale * (arm[k, 0] * arm[k, 0] + arm[k, 1] * arm[k, 1])
            x += scale * measured[k, 0]
            y += scale * measured[k, 1]
            turn += scale * (arm[k, 0] * measured[k, 1] - arm[k, 1] * measured[k, 0])
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
        chi2 = total * (estimate[0] * estimate[0] + estimate[1] * estimate[1]) + square * estimate[2] * estimate[2]
        chi2 += 2 * estimate[2] * (sum_x * estimate[1] - sum_y * estimate[0])
        for k in range(arm.shape[0]):
            dx = measured[k, 0] - estimate[0] + estimate[2] * arm[k, 1]
            dy = measured[k, 1] - estimate[1] - estimate[2] * arm[k, 0]
            robust[k] = 1 / (1 + precision[k] * (dx * dx + dy * dy) / 4)
    return chi2
