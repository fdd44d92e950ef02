# SPDX-License-Identifier: Apache-2.0
"""What the boxes of two agents say of a candidate pose: the input of the learned verification.

Of the pairs: their evidence under heavy tails, and how independent they are. Vehicles of one lane or one row of bays agree more
easily than those of two roads. Of the other boxes: under the right pose those that only one agent observes overlap none of the
other agent's, stand in the same lanes and drive in the same directions. Of the vote: score, margin and numbers of boxes.

All features are invariant to both agents' frames, to the order of boxes and candidates, and to which agent is the ego.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import Boolx1, F64x1, F64x2, I64x2, njit
from manyeyes.models.pose.candidate_verifier import NUM_FEATURES
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import Candidate

PAIR_FEATURES = (
    "sum of log-likelihood ratios of positions",
    "smallest of them",
    "sum of log-likelihood ratios of headings",
    "sum of log-likelihoods of sizes",
    "pairs whose headings differ by pi",
    "pairs",
    "distinct lanes of pairs",
    "pairs in the lane of a pair, mean",
    "pairs across a pair, mean",
    "log of the mean distance of pairs",
)
BOX_FEATURES = (
    "overlaps of unpaired boxes",
    "unpaired boxes too close in a lane",
    "log fraction of lateral distances below 0.6 m",
    "log fraction from 0.6 to 1.3 m",
    "log fraction from 1.3 to 2.2 m",
    "parallel unpaired boxes",
    "fraction with equal directions in a lane",
    "fraction of parallel boxes",
    "log of the overlaps",
)
VOTE_FEATURES = (
    "score",
    "margin over the best other candidate",
    "log of the number of compared boxes",
    "its square",
    "log of the smaller number of boxes",
    "score per pair",
)
FEATURES = PAIR_FEATURES + BOX_FEATURES + VOTE_FEATURES
assert len(FEATURES) == NUM_FEATURES

_PI = np.pi
_X, _Y, _YAW, _LENGTH, _WIDTH, _SIGMA_XY, _SIGMA_YAW = range(7)
_LONGITUDINAL, _LATERAL, _TAIL, _TAIL_SCALE = 1.2, 0.8, 0.08, 3.0
"""Errors of real boxes: longitudinal and lateral over the stated one; fraction and scale of the tail of positions."""
_YAW_CORE, _YAW_TAIL, _YAW_TAIL_SCALE = 0.75, 0.1, 4.0
_CHANCE_AREA_M2, _CHANCE_TURN_RAD = 330.0, 0.35
_SIGMA_LENGTH_M, _SIGMA_WIDTH_M = 0.25, 0.14
_LANE_M, _PARALLEL_RAD, _MAX_GAP_M = 1.5, 0.2, 70.0
_OVERLAP_M, _SHORT_GAP_M, _OVERLAP_WIDTH_M = -0.3, 1.5, 1.6


def compute_features(
    ego: Landmarks, other: Landmarks, found: Sequence[Candidate], max_count: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the features (max_count, NUM_FEATURES) of the first candidates, and which rows exist (max_count,).

    Landmarks are of one instant; candidates are all that the vote found, best first.
    """
    out, exists = np.zeros((max_count, NUM_FEATURES)), np.zeros(max_count, bool)
    a, b = _make_columns(ego), _make_columns(other)
    scores = np.array([one.score for one in found])
    logs = np.log([max(len(ego), 1), max(len(other), 1)])
    for k, one in enumerate(found[:max_count]):
        describe_candidate(a, b, one.pose, np.ascontiguousarray(one.pairs), out[k])
        rest = max(np.delete(scores, k), default=0.0)
        num_pairs = max(len(one.pairs), 1)
        out[k, -len(VOTE_FEATURES) :] = (
            one.score,
            one.score - rest,
            logs.sum(),
            logs.sum() ** 2,
            logs.min(),
            one.score / num_pairs,
        )
        exists[k] = True
    return out.astype(np.float32), exists


def _make_columns(x: Landmarks) -> NDArray[np.float64]:
    return np.column_stack((x.xy, x.yaw, x.size, x.sigma_xy, x.sigma_yaw))


@njit(cache=True, nogil=True)
def describe_candidate(
    a: F64x2, b: F64x2, pose: F64x1, pairs: I64x2, out: F64x1
) -> None:  # pragma: no cover - compiled
    """Write the features of pairs and boxes; a, b: (N, 7) x, y, yaw, length, width, sigma_xy, sigma_yaw, each in its frame."""
    moved = b.copy()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for k in range(len(b)):
        moved[k, _X] = c * b[k, _X] - s * b[k, _Y] + pose[0]
        moved[k, _Y] = s * b[k, _X] + c * b[k, _Y] + pose[1]
        moved[k, _YAW] = b[k, _YAW] + pose[2]
    is_paired_a, is_paired_b = np.zeros(len(a), np.bool_), np.zeros(len(b), np.bool_)
    place = np.empty((len(pairs), 3))
    smallest = 0.0
    for p in range(len(pairs)):
        i, k = pairs[p, 0], pairs[p, 1]
        is_paired_a[i] = is_paired_b[k] = True
        ahead, aside, turn = _relate(a[i], moved[k])
        gain = _position_gain(ahead, aside, a[i, _SIGMA_XY] ** 2 + moved[k, _SIGMA_XY] ** 2)
        out[0] += gain
        smallest = min(smallest, gain)
        out[2] += _heading_gain(turn, a[i, _SIGMA_YAW] ** 2 + moved[k, _SIGMA_YAW] ** 2)
        out[3] -= 0.5 * ((a[i, _LENGTH] - b[k, _LENGTH]) / _SIGMA_LENGTH_M) ** 2
        out[3] -= 0.5 * ((a[i, _WIDTH] - b[k, _WIDTH]) / _SIGMA_WIDTH_M) ** 2
        if np.cos(a[i, _YAW] - moved[k, _YAW]) < 0.0:
            out[4] += 1.0
        place[p, _X] = 0.5 * (a[i, _X] + moved[k, _X])
        place[p, _Y] = 0.5 * (a[i, _Y] + moved[k, _Y])
        place[p, _YAW] = a[i, _YAW] - 0.5 * turn
    out[1], out[5] = smallest, len(pairs)
    _describe_pairs(place, out)
    _describe_boxes(a, moved, is_paired_a, is_paired_b, out)


@njit(cache=True, nogil=True)
def _relate(a: F64x1, b: F64x1) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Return longitudinal and lateral distance (m) in the mean axis of two boxes, and the angle of their axes (rad)."""
    off = a[_YAW] - b[_YAW]
    turn = off - _PI * np.floor(off / _PI + 0.5)
    axis = a[_YAW] - 0.5 * turn
    c, s = np.cos(axis), np.sin(axis)
    dx, dy = b[_X] - a[_X], b[_Y] - a[_Y]
    return abs(c * dx + s * dy), abs(c * dy - s * dx), turn


@njit(cache=True, nogil=True)
def _position_gain(ahead: float, aside: float, variance: float) -> float:  # pragma: no cover - compiled
    """Return the log-likelihood ratio of a residual: the mixture of two boxes with heavy tails, against chance."""
    density = 1e-9 / _CHANCE_AREA_M2
    for number in range(3):
        weight = (1.0 - _TAIL) ** 2 if number == 0 else 2.0 * _TAIL * (1.0 - _TAIL) if number == 1 else _TAIL * _TAIL
        wide = 1.0 if number == 0 else 0.5 * (1.0 + _TAIL_SCALE**2) if number == 1 else _TAIL_SCALE**2
        along, across = variance * wide * _LONGITUDINAL**2, variance * wide * _LATERAL**2
        exponent = -0.5 * (ahead * ahead / along + aside * aside / across)
        density += weight * np.exp(exponent) / (2.0 * _PI * np.sqrt(along * across))
    return np.log(density * _CHANCE_AREA_M2)


@njit(cache=True, nogil=True)
def _heading_gain(turn: float, variance: float) -> float:  # pragma: no cover - compiled
    """Return the log-likelihood ratio of a difference of headings with heavy tails, against chance."""
    density = 1e-9 / _CHANCE_TURN_RAD
    for number in range(3):
        weight = (1.0 - _YAW_TAIL) ** 2 if number == 0 else 2.0 * _YAW_TAIL * (1.0 - _YAW_TAIL)
        weight = _YAW_TAIL * _YAW_TAIL if number == 2 else weight
        wide = 1.0 if number == 0 else 0.5 * (1.0 + _YAW_TAIL_SCALE**2) if number == 1 else _YAW_TAIL_SCALE**2
        spread = variance * wide * _YAW_CORE**2
        density += weight * np.exp(-0.5 * turn * turn / spread) / np.sqrt(2.0 * _PI * spread)
    return np.log(density * _CHANCE_TURN_RAD)


@njit(cache=True, nogil=True)
def _describe_pairs(place: F64x2, out: F64x1) -> None:  # pragma: no cover - compiled
    """Write how the pairs (P, 3), x, y (m) and axis (rad), stand to each other."""
    num_same = num_across = distance = 0.0
    for p in range(len(place)):
        is_new = True
        for q in range(len(place)):
            if p == q:
                continue
            ahead, aside, turn = _relate(place[p], place[q])
            distance += np.hypot(ahead, aside)
            if abs(turn) > 0.26:
                num_across += 1.0
            elif aside < _LANE_M:
                num_same += 1.0
                is_new = is_new and q > p
        out[6] += 1.0 if is_new else 0.0
    count = max(len(place), 1)
    out[7], out[8] = num_same / count, num_across / count
    out[9] = np.log1p(distance / max(count * (count - 1), 1))


@njit(cache=True, nogil=True)
def _describe_boxes(
    a: F64x2, b: F64x2, is_paired_a: Boolx1, is_paired_b: Boolx1, out: F64x1
) -> None:  # pragma: no cover - compiled
    """Write how the unpaired boxes of a and b, in one frame, stand to each other."""
    bins = np.zeros(4)
    num_overlaps = num_close = num_parallel = num_lane = num_directed = 0.0
    for i in range(len(a)):
        if is_paired_a[i]:
            continue
        for k in range(len(b)):
            if is_paired_b[k]:
                continue
            ahead, aside, turn = _relate(a[i], b[k])
            gap = ahead - 0.5 * (a[i, _LENGTH] + b[k, _LENGTH])
            if aside < _OVERLAP_WIDTH_M and gap < _OVERLAP_M:
                num_overlaps += 1.0
            elif aside < _OVERLAP_WIDTH_M and gap < _SHORT_GAP_M:
                num_close += 1.0
            if abs(turn) > _PARALLEL_RAD:
                continue
            num_parallel += 1.0
            if ahead < _MAX_GAP_M and aside < 2.9:
                bins[0 if aside < 0.6 else 1 if aside < 1.3 else 2 if aside < 2.2 else 3] += 1.0
                if aside < 1.0:
                    num_lane += 1.0
                    num_directed += 1.0 if np.cos(a[i, _YAW] - b[k, _YAW]) > 0.0 else 0.0
    total = bins.sum()
    out[10], out[11] = num_overlaps, num_close
    for n in range(3):
        out[12 + n] = np.log((bins[n] + 1.0) / (total + 3.0))
    out[15], out[16] = total / 10.0, (num_directed + 1.0) / (num_lane + 2.0)
    out[17], out[18] = 4.0 * num_parallel / max(len(a) * len(b), 1), np.log1p(num_overlaps)
