# SPDX-License-Identifier: Apache-2.0
"""The joint system without the couplings between observations, factorized: the preconditioner of its conjugate gradients.

Without these couplings each pose depends on the bias of its drive there alone, and that on those before and after it. So poses are
eliminated one by one (Schur complement), and what is left is block tridiagonal along each drive.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from manyeyes._jit import F64x1, F64x2, F64x3, I64x1, njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class DriveFactor(NamedTuple):
    """Factors of a symmetric matrix of O poses, then S biases, three unknowns each.

    state: (O,) the bias of each pose. pose_inverse: (O, 3, 3) of the blocks on the diagonal. coupling: (O, 3, 3) blocks of poses
    and their biases. state_inverse: (S, 3, 3) of the blocks that are left of the biases after those before them are eliminated.
    step: (S, 3, 3) blocks of each bias and the one before it; 0 at the start of a drive.
    """

    state: I64x1
    pose_inverse: F64x3
    coupling: F64x3
    state_inverse: F64x3
    step: F64x3

    @classmethod
    def of_matrix(cls, matrix: bsr_array, state: Ints, is_linked: NDArray[np.bool_]) -> DriveFactor:
        """Factorize a matrix with sorted columns; is_linked: (S,) biases that depend on the one before them."""
        count, states = len(state), len(is_linked)
        row, after = np.arange(count + states), count + np.flatnonzero(is_linked)
        diagonal, coupling = _take_blocks(matrix, row, row), _take_blocks(matrix, row[:count], count + state)
        pose_inverse, step = np.asarray(np.linalg.inv(diagonal[:count]), np.float64), np.zeros((states, 3, 3))
        step[is_linked] = _take_blocks(matrix, after, after - 1)
        np.subtract.at(diagonal, count + state, coupling.transpose(0, 2, 1) @ pose_inverse @ coupling)
        state_inverse = diagonal[count:]
        _invert_along_drives(state_inverse, step)
        return cls(state, pose_inverse, coupling, state_inverse, step)


def _take_blocks(matrix: bsr_array, row: Ints, column: Ints) -> Floats:
    """Return the blocks (N, 3, 3) of a matrix with sorted columns at rows and columns (N,), which it must hold."""
    size = len(matrix.indptr) - 1
    place = np.repeat(np.arange(size), np.diff(matrix.indptr)) * size + matrix.indices
    return np.asarray(matrix.data, np.float64)[np.searchsorted(place, row * size + column)]


@njit(cache=True, nogil=True)
def _invert_along_drives(block: F64x3, step: F64x3) -> None:  # pragma: no cover - compiled
    """Replace blocks (S, 3, 3) by the inverses of what is left of each after the ones before it are eliminated."""
    inverse, pulled = np.zeros((3, 3)), np.empty((3, 3))
    for s in range(len(block)):
        # block - step inverse step', where inverse is that of the state before.
        for i in range(3):
            for j in range(3):
                pulled[i, j] = (
                    step[s, i, 0] * inverse[0, j] + step[s, i, 1] * inverse[1, j] + step[s, i, 2] * inverse[2, j]
                )
        for i in range(3):
            for j in range(3):
                part = pulled[i, 0] * step[s, j, 0] + pulled[i, 1] * step[s, j, 1] + pulled[i, 2] * step[s, j, 2]
                block[s, i, j] -= part
        _invert_symmetric(block[s], inverse)
        for i in range(3):
            for j in range(3):
                block[s, i, j] = inverse[i, j]


@njit(cache=True, nogil=True)
def _invert_symmetric(m: F64x2, out: F64x2) -> None:  # pragma: no cover - compiled
    """Set out to the inverse of a symmetric matrix (3, 3)."""
    xx, xy, xt = m[0, 0], m[0, 1], m[0, 2]
    yy, yt, tt = m[1, 1], m[1, 2], m[2, 2]
    a, b, c = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    d = 1.0 / (xx * a + xy * b + xt * c)
    out[0, 0], out[0, 1], out[0, 2] = a * d, b * d, c * d
    out[1, 0], out[1, 1], out[1, 2] = b * d, (xx * tt - xt * xt) * d, (xy * xt - xx * yt) * d
    out[2, 0], out[2, 1], out[2, 2] = c * d, out[1, 2], (xx * yy - xy * xy) * d


@njit(cache=True, nogil=True)
def solve_chain(factor: DriveFactor, poses: F64x2, biases: F64x2) -> None:  # pragma: no cover - compiled
    """Replace right sides of poses (O, 3) and biases (S, 3) by the solution."""
    state, pose_inverse, coupling, state_inverse, step = factor
    moved, pulled = np.empty(3), np.empty(3)
    for o in range(len(poses)):
        _multiply(pose_inverse[o], poses[o], moved)
        bias = biases[state[o]]
        for i in range(3):
            poses[o, i] = moved[i]
            bias[i] -= coupling[o, 0, i] * moved[0] + coupling[o, 1, i] * moved[1] + coupling[o, 2, i] * moved[2]
    for s in range(1, len(biases)):
        _multiply(state_inverse[s - 1], biases[s - 1], moved)
        for i in range(3):
            biases[s, i] -= step[s, i, 0] * moved[0] + step[s, i, 1] * moved[1] + step[s, i, 2] * moved[2]
    for s in range(len(biases) - 1, -1, -1):
        if s + 1 < len(biases):
            x, y, t = biases[s + 1, 0], biases[s + 1, 1], biases[s + 1, 2]
            for i in range(3):
                biases[s, i] -= step[s + 1, 0, i] * x + step[s + 1, 1, i] * y + step[s + 1, 2, i] * t
        _multiply(state_inverse[s], biases[s], moved)
        for i in range(3):
            biases[s, i] = moved[i]
    for o in range(len(poses)):
        _multiply(coupling[o], biases[state[o]], pulled)
        _multiply(pose_inverse[o], pulled, moved)
        for i in range(3):
            poses[o, i] -= moved[i]


@njit(cache=True, nogil=True)
def _multiply(matrix: F64x2, vector: F64x1, out: F64x1) -> None:  # pragma: no cover - compiled
    """Set out (3,) to the product of a matrix (3, 3) and a vector (3,)."""
    for i in range(3):
        out[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]
