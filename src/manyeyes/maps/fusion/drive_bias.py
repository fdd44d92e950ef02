# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose bias that all observations of one drive share (random-effects model).

The error of a satellite receiver drifts slowly. So the error of a prior pose is b + e, where b is constant over the drive and
has the fraction ``drive_correlation`` (rho) of the prior covariance P, and e is independent per observation and has the rest.
If the lines give an observation a correction d with information L, then d observes b with information W = (L^-1 + (1 - rho)
P)^-1. The mode of b given all observations of the drive is (sum W + (rho P)^-1)^-1 sum W d (random-effects mean; Laird and
Ware, Biometrics 1982). A prior pose that is off by much more than its covariance is usually off for the whole drive, so the
prior on b is down-weighted beyond ``robust_scale`` standard deviations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_ROUNDS = 5
_FREE = 0.02


def estimate_drive_bias(
    information_matrix: Floats,
    information_vector: Floats,
    prior_covariance: Floats,
    drive: Ints,
    drive_correlation: float,
    robust_scale: float,
) -> Floats:
    """Estimate the bias (O, 3) in metres, metres, radians of each observation's drive, to be added to its prior pose.

    Args:
        information_matrix: (O, 3, 3) information L of the lines on each pose; may be singular.
        information_vector: (O, 3) L d, where d is the correction of the prior pose that the lines give.
        prior_covariance: (O, 3, 3) covariance P of the prior pose.
        drive: (O,) drive of each observation, from 0.
        drive_correlation: fraction of the prior covariance that is common to a drive.
        robust_scale: Geman-McClure scale of the prior on the bias, in standard deviations.
    """
    count = int(drive.max(initial=-1)) + 1
    blurred = np.eye(3) + (1.0 - drive_correlation) * information_matrix @ prior_covariance
    weight, pull, covariance_sum = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    np.add.at(weight, drive, np.linalg.solve(blurred, information_matrix))
    np.add.at(pull, drive, np.linalg.solve(blurred, information_vector[:, :, None])[:, :, 0])
    np.add.at(covariance_sum, drive, prior_covariance)
    prior = np.linalg.inv(drive_correlation * covariance_sum / np.bincount(drive, minlength=count)[:, None, None])
    # Start with a weak prior, so that a large bias is found; the prior weight of a small one grows with each iteration.
    prior_weight, error = np.full(count, _FREE), np.zeros((count, 3))
    for _ in range(_ROUNDS):
        error = np.asarray(
            np.linalg.solve(weight + prior_weight[:, None, None] * prior, pull[:, :, None])[:, :, 0], np.float64
        )
        far = drive_correlation * np.einsum("ai,aij,aj->a", error, prior, error)
        prior_weight = (robust_scale**2 / (robust_scale**2 + far)) ** 2
    return error[drive]
