# SPDX-License-Identifier: Apache-2.0
"""Conjugate gradients of the joint system, against the dense matrix."""

from __future__ import annotations

import numpy as np
import pytest
from tests.maps.test_drive_factor import make_matrix

from manyeyes.maps.fusion.conjugate_gradients import solve_by_conjugate_gradients
from manyeyes.maps.fusion.drive_factor import DriveFactor
from manyeyes.maps.fusion.joint_solver import JointSystem
from manyeyes.maps.fusion.pair_blocks import PairBlocks

IS_LINKED, STATE = np.array([False, True, False, True]), np.array([2, 0, 3, 1])


def make_system(scale):
    """Four poses, coupled 0-2, 0-3 and 1-3 by blocks of this size, and their biases in two chains."""
    rng = np.random.default_rng(4)
    pairs = PairBlocks(
        np.zeros((4, 3, 3)), np.zeros((4, 3)), np.array([0, 2, 3, 3, 3]), np.array([2, 3, 3]),
        scale * rng.normal(size=(3, 3, 3)),
    )  # fmt: skip
    return JointSystem(make_matrix(STATE, IS_LINKED), pairs, rng.normal(size=24))


def solve(system, tolerance=1e-12, max_iterations=200):
    factor = DriveFactor.of_matrix(system.apart, STATE, IS_LINKED)
    return solve_by_conjugate_gradients(
        system.apart, system.pairs, factor, system.right_side, tolerance, max_iterations
    )


def test_the_solution_is_that_of_the_dense_matrix():
    system = make_system(0.02)
    before = system.right_side.copy()
    dense = system.to_matrix().toarray()
    assert np.linalg.eigvalsh(dense).min() > 0.0
    np.testing.assert_allclose(solve(system), np.linalg.solve(dense, before), rtol=1e-8)
    np.testing.assert_array_equal(system.right_side, before)


def test_without_couplings_one_iteration_is_enough():
    system = make_system(0.0)
    np.testing.assert_allclose(
        solve(system, max_iterations=1), np.linalg.solve(system.to_matrix().toarray(), system.right_side), rtol=1e-8
    )


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_it_stops_at_the_first_residual_below_the_tolerance(tolerance):
    system = make_system(0.05)
    matrix, right = system.to_matrix().toarray(), system.right_side

    def residual(solution):
        return np.linalg.norm(right - matrix @ solution) / np.linalg.norm(right)

    found = solve(system, tolerance)
    needed = next(n for n in range(50) if residual(solve(system, 0.0, n)) <= tolerance)
    assert 1 < needed < 50
    np.testing.assert_array_equal(found, solve(system, 0.0, needed))


def test_a_right_side_of_zero_has_the_solution_zero():
    system = make_system(0.02)
    system.right_side[:] = 0.0
    assert (solve(system) == 0.0).all()
