# SPDX-License-Identifier: Apache-2.0
"""The bias of a drive, against the mode of the complete model solved at once."""

from __future__ import annotations

import numpy as np
import pytest

from manyeyes.maps.fusion.drive_bias import estimate_drive_bias

P = np.diag([0.16, 0.16, 0.0001])
FAR = 1e6  # sigmas: the prior never lets go


def make_information(information, correction):
    """Information matrices (O, 3, 3) and vectors (O, 3) of observations with these corrections (O, 3)."""
    return np.array(information), np.einsum("oij,oj->oi", np.array(information), np.array(correction))


def whole_model(information_matrix, information_vector, drive_correlation):
    """Reference: the mode of b and all e_i together, from sum (d - b - e)' L (d - b - e) + e' P_own^-1 e + b' P_all^-1 b."""
    count = len(information_matrix)
    normal, right = np.zeros((3 * count + 3, 3 * count + 3)), np.zeros(3 * count + 3)
    normal[:3, :3] = np.linalg.inv(drive_correlation * P)
    for k in range(count):
        rows = slice(3 * k + 3, 3 * k + 6)
        normal[:3, :3] += information_matrix[k]
        normal[:3, rows] += information_matrix[k]
        normal[rows, :3] += information_matrix[k]
        normal[rows, rows] += information_matrix[k] + np.linalg.inv((1 - drive_correlation) * P)
        right[:3] += information_vector[k]
        right[rows] += information_vector[k]
    return np.linalg.solve(normal, right)[:3]


@pytest.mark.parametrize("drive_correlation", [0.2, 0.5, 0.8])
def test_bias_is_mode_of_joint_model_with_rank_deficient_information(drive_correlation):
    rng = np.random.default_rng(1)
    roots = rng.normal(0.0, 2.0, (4, 3, 3))
    roots[1, 1:] = 0.0  # only one direction
    roots[2] = 0.0  # nothing
    information_matrix, information_vector = make_information(
        roots.transpose(0, 2, 1) @ roots, rng.normal(0.0, 0.3, (4, 3))
    )
    found = estimate_drive_bias(
        information_matrix, information_vector, np.tile(P, (4, 1, 1)), np.zeros(4, np.int64), drive_correlation, FAR
    )
    assert found == pytest.approx(
        np.tile(whole_model(information_matrix, information_vector, drive_correlation), (4, 1)), abs=1e-9
    )


def test_bias_applies_to_unobserved_poses_of_same_drive_only():
    information_matrix, information_vector = make_information(
        [1e4 * np.eye(3)] * 3 + [np.zeros((3, 3))] * 2, [(0.6, 0.0, 0.01)] * 3 + [(0.0, 0.0, 0.0)] * 2
    )
    found = estimate_drive_bias(
        information_matrix, information_vector, np.tile(P, (5, 1, 1)), np.array([0, 0, 0, 0, 1]), 0.5, FAR
    )
    # Three fully observable poses: 3 / (3 + 1) of their mean, since own and common variance are equal.
    assert found[:4, :2] == pytest.approx(np.tile((0.45, 0.0), (4, 1)), abs=1e-2)
    assert found[4] == pytest.approx(np.zeros(3))


def test_large_bias_is_not_shrunk():
    information_matrix, information_vector = make_information([1e4 * np.eye(3)], [(3.0, 0.0, 0.0)])
    prior_covariance, drive = P[None], np.zeros(1, np.int64)
    assert estimate_drive_bias(information_matrix, information_vector, prior_covariance, drive, 0.5, FAR)[
        0, 0
    ] == pytest.approx(1.5, abs=0.01)
    assert estimate_drive_bias(information_matrix, information_vector, prior_covariance, drive, 0.5, 3.0)[0, 0] > 2.8
    assert (
        len(
            estimate_drive_bias(
                information_matrix[:0], information_vector[:0], prior_covariance[:0], drive[:0], 0.5, 3.0
            )
        )
        == 0
    )
