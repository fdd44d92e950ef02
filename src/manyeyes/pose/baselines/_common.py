# SPDX-License-Identifier: Apache-2.0
"""Helpers of the baselines: fit a pose to pairs, and make an estimate of it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.ops.rigid import fit_se2
from manyeyes.pose.corrector import mahalanobis_squared
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, lift_to_se3

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def fit_pose(target: Floats, source: Floats, weight: Floats | None = None) -> Floats:
    """target_from_source (3,) of the weighted least-squares fit of points (N, 2) to points (N, 2)."""
    given = None if weight is None else torch.from_numpy(weight)
    return fit_se2(torch.from_numpy(source), torch.from_numpy(target), given).numpy()


def make_estimate(ego: Landmarks, other: Landmarks, pose: Floats, pairs: Ints, prior: PosePrior | None) -> PoseEstimate:
    """Return the estimate of a pose (3,), with the covariance that its pairs (P, 2) give by their stated errors."""
    covariance = np.asarray(np.linalg.inv(pose_information(ego, other, pose, pairs)), np.float64)
    distance = float("nan") if prior is None else mahalanobis_squared(pose, covariance, prior)
    return PoseEstimate(
        lift_to_se3(pose, prior),
        covariance,
        PoseStatus.CORRECTED,
        len(pairs),
        0,
        0.0,
        pairs,
        pose,
        covariance,
        distance,
    )


def pose_information(ego: Landmarks, other: Landmarks, pose: Floats, pairs: Ints) -> Floats:
    """Return (3, 3) information of x, y (m), yaw (rad) from pairs of positions and headings."""
    i, k = pairs.T
    w, v = 1 / (ego.sigma_xy[i] ** 2 + other.sigma_xy[k] ** 2), 1 / (ego.sigma_yaw[i] ** 2 + other.sigma_yaw[k] ** 2)
    arm = other.transform(np.array([0.0, 0.0, pose[2]])).xy[k]
    x, y = arm[:, 0], arm[:, 1]
    total, turn = w.sum(), (w * (x**2 + y**2) + v).sum()
    return np.array([[total, 0.0, -(w * y).sum()], [0.0, total, (w * x).sum()], [-(w * y).sum(), (w * x).sum(), turn]])


def match_mutual_nearest(target: Floats, source: Floats, max_distance_m: float) -> Ints:
    """Return pairs (P, 2) of rows of target (N, 2) and source (M, 2) that are mutual nearest neighbours within a distance."""
    if not len(target) or not len(source):
        return np.zeros((0, 2), np.int64)
    apart = np.hypot(*(target[:, None] - source[None]).transpose(2, 0, 1))
    best = apart.argmin(1)
    rows = np.arange(len(target))
    mutual = (apart.argmin(0)[best] == rows) & (apart[rows, best] <= max_distance_m)
    return np.stack((rows[mutual], best[mutual]), 1)
