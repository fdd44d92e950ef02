# SPDX-License-Identifier: Apache-2.0
"""The factor of a joint system without couplings between observations, against the dense matrix."""

from __future__ import annotations

import numpy as np

from manyeyes.maps.fusion.drive_factor import DriveFactor, solve_chain
from manyeyes.maps.fusion.joint_solver import bsr_from_blocks


def make_matrix(state, is_linked, seed=0):
    """A positive definite matrix: poses with their own blocks and that of their bias, biases in chains."""
    rng = np.random.default_rng(seed)
    count, states = len(state), len(is_linked)

    def squares(n):
        root = rng.normal(size=(n, 3, 3))
        return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)

    own, step = squares(count), squares(int(is_linked.sum()))
    rows, at, after = np.arange(count), count + state, count + np.flatnonzero(is_linked)
    every = count + np.arange(states)
    families = [
        (rows, rows, squares(count) + own), (rows, at, -own), (at, rows, -own), (at, at, own),
        (every, every, squares(states)), (after, after, step), (after - 1, after - 1, step),
        (after, after - 1, -step), (after - 1, after, -step),
    ]  # fmt: skip
    return bsr_from_blocks(families, count + states)


def solve(matrix, state, is_linked, right):
    solution = right.reshape(-1, 3).copy()
    solve_chain(DriveFactor.of_matrix(matrix, state, is_linked), solution[: len(state)], solution[len(state) :])
    return solution.ravel()


def test_a_right_side_is_solved_as_by_the_dense_matrix():
    is_linked = np.array([False, True, True, False, False, True, True, True])
    state = np.array([5, 2, 0, 7, 1, 3, 6, 4])
    matrix = make_matrix(state, is_linked)
    right = np.random.default_rng(1).normal(size=matrix.shape[0])
    found = solve(matrix, state, is_linked, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), right), rtol=1e-9)


def test_several_poses_may_share_a_bias_and_one_pose_may_stand_alone():
    state, is_linked = np.array([0, 0, 1]), np.array([False, False])
    matrix = make_matrix(state, is_linked, 2)
    right = np.ones(15)
    found = solve(matrix, state, is_linked, right)
    np.testing.assert_allclose(matrix @ found, right, atol=1e-9)
    alone = make_matrix(np.array([0]), np.array([False]), 3)
    np.testing.assert_allclose(alone @ solve(alone, np.array([0]), np.array([False]), np.ones(6)), 1.0)
