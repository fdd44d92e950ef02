# SPDX-License-Identifier: Apache-2.0
"""Conjugate gradients for the joint system: preconditioned by the factors of all but the couplings between observations.

Hestenes and Stiefel, 1952; preconditioned as in Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm 9.1. SciPy has
the same method, but of a small system its calls take longer than the products.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from manyeyes._jit import F64x2, F64x3, I64x1, njit, set_rows
from manyeyes.maps.fusion.drive_factor import DriveFactor, solve_chain
from manyeyes.maps.fusion.pair_blocks import PairBlocks, multiply_couplings

Floats = NDArray[np.float64]


def solve_by_conjugate_gradients(
    apart: bsr_array, pairs: PairBlocks, factor: DriveFactor, right_side: Floats, tolerance: float, max_iterations: int
) -> Floats:
    """Solve for a right side (3 (O + S),) of O poses, then S biases, from 0.

    Args:
        apart: the matrix without the couplings between observations; factor: its factors. pairs: holds the couplings.
        tolerance: it stops where the norm of the residual is at most this times that of the right side, or after max_iterations.
    """
    solution = np.zeros((len(right_side) // 3, 3))
    residual = right_side.reshape(-1, 3).copy()
    _iterate(
        (apart.indptr.astype(np.int64), apart.indices.astype(np.int64), np.asarray(apart.data, np.float64)),
        pairs,
        factor,
        solution,
        residual,
        tolerance,
        max_iterations,
    )
    return solution.reshape(-1)


@njit(cache=True, nogil=True)
def _iterate(
    apart: tuple[I64x1, I64x1, F64x3],
    pairs: PairBlocks,
    factor: DriveFactor,
    solution: F64x2,
    residual: F64x2,
    tolerance: float,
    max_iterations: int,
) -> None:  # pragma: no cover - compiled
    """Add to the solution until its residual is small; residual: the right side less the matrix times the solution."""
    num_poses = len(pairs.own)
    goal = tolerance * tolerance * _dot(residual, residual)
    direction, product = np.zeros_like(residual), np.empty_like(residual)
    preconditioned = np.empty_like(residual)
    last_square = 1.0
    for iteration in range(max_iterations):
        if _dot(residual, residual) <= goal:
            break
        set_rows(preconditioned, residual)
        solve_chain(factor, preconditioned[:num_poses], preconditioned[num_poses:])
        square = _dot(residual, preconditioned)
        _add_scaled(preconditioned, direction, square / last_square if iteration else 0.0)
        direction, preconditioned = preconditioned, direction
        _multiply_blocks(apart, direction, product)
        multiply_couplings(pairs, direction[:num_poses], product[:num_poses])
        rate = square / _dot(direction, product)
        _add_scaled(solution, direction, rate)
        _add_scaled(residual, product, -rate)
        last_square = square


@njit(cache=True, nogil=True)
def _multiply_blocks(
    matrix: tuple[I64x1, I64x1, F64x3], vector: F64x2, out: F64x2
) -> None:  # pragma: no cover - compiled
    """Set out (N, 3) to the product of a matrix, offsets of rows, columns and blocks (B, 3, 3), and a vector (N, 3)."""
    offsets, columns, blocks = matrix
    for row in range(len(out)):
        x, y, t = 0.0, 0.0, 0.0
        for k in range(offsets[row], offsets[row + 1]):
            u, v, w = vector[columns[k], 0], vector[columns[k], 1], vector[columns[k], 2]
            x += blocks[k, 0, 0] * u + blocks[k, 0, 1] * v + blocks[k, 0, 2] * w
            y += blocks[k, 1, 0] * u + blocks[k, 1, 1] * v + blocks[k, 1, 2] * w
            t += blocks[k, 2, 0] * u + blocks[k, 2, 1] * v + blocks[k, 2, 2] * w
        out[row, 0], out[row, 1], out[row, 2] = x, y, t


@njit(cache=True, nogil=True)
def _dot(a: F64x2, b: F64x2) -> float:  # pragma: no cover - compiled
    total = 0.0
    for k in range(len(a)):
        total += a[k, 0] * b[k, 0] + a[k, 1] * b[k, 1] + a[k, 2] * b[k, 2]
    return total


@njit(cache=True, nogil=True)
def _add_scaled(to: F64x2, vector: F64x2, scale: float) -> None:  # pragma: no cover - compiled
    """Add scale times a vector (N, 3) to another."""
    for k in range(len(to)):
        for i in range(3):
            to[k, i] += scale * vector[k, i]
