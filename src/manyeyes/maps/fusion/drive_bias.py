# SPDX-License-Identifier: Apache-2.0
"""The error that all looks of one drive share: what lines tell of some of them holds for the others too.

A satellite receiver's error drifts slowly, so the error of a claim is b + e: b is one for the drive and has the share
``alike`` of the claimed covariance P, e is each look's own and has the rest. Where lines tell of a look's error d with
information L, d says of b what is left after e: W = (L^-1 + (1 - alike) P)^-1. The mode of b given all looks of the
drive is (sum W + (alike P)^-1)^-1 sum W d, a random-effects mean (Laird and Ware, Biometrics 1982). Claims that are off
by much more than they say are usually off for a whole drive, so beyond ``scale`` sigmas the prior on b lets go. Source of
the idea: specs/maps.md 3.4 stage 2 (consecutive poses of a pass share a bias); here it is one number a drive.
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
    """(O, 3) metres, metres, radians: by how much the claims of each look's drive are off alike, to be added to them.

    information_matrix: (O, 3, 3) information L of the lines on each look's pose, which may be singular; information_vector: (O, 3)
    L d, where d is the correction of the claim that the lines ask for. prior_covariance: (O, 3, 3) covariance P. drive: (O,) which
    drive, from 0.
    """
    count = int(drive.max(initial=-1)) + 1
    blurred = np.eye(3) + (1.0 - drive_correlation) * information_matrix @ prior_covariance
    weight, pull, covariance_sum = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    np.add.at(weight, drive, np.linalg.solve(blurred, information_matrix))
    np.add.at(pull, drive, np.linalg.solve(blurred, information_vector[:, :, None])[:, :, 0])
    np.add.at(covariance_sum, drive, prior_covariance)
    prior = np.linalg.inv(drive_correlation * covariance_sum / np.bincount(drive, minlength=count)[:, None, None])
    # From where the prior hardly counts: a drive that is far off is found, one that is not is shrunk round by round.
    prior_weight, error = np.full(count, _FREE), np.zeros((count, 3))
    for _ in range(_ROUNDS):
        error = np.asarray(
            np.linalg.solve(weight + prior_weight[:, None, None] * prior, pull[:, :, None])[:, :, 0], np.float64
        )
        far = drive_correlation * np.einsum("ai,aij,aj->a", error, prior, error)
        prior_weight = (robust_scale**2 / (robust_scale**2 + far)) ** 2
    return error[drive]
