# SPDX-License-Identifier: Apache-2.0
"""Factors of a sparse symmetric system, and the inverse on their pattern.

The inverse Z of L D L' follows from the last columns to the first (Takahashi, Fagan and Chin, 1973; Erisman and Tinney, 1975).
Columns J one after the other that have the same rows R below them are done together, as dense products:

    Z_RJ = -Z_RR Y,    Z_JJ = L_JJ^-T D_J^-1 L_JJ^-1 - Z_RJ' Y,    Y = L_RJ L_JJ^-1

All entries of Z_RR are on the pattern of the columns R: what a column holds below its first row under the diagonal, the column of
that row holds, too. An entry of L that cancels to an exact zero is not stored by the solver, and is put back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from manyeyes._jit import F64x1, F64x2, F64x3, I32x1, I64x1, njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MAX_COLUMNS = 256
"""How many columns are done together."""
(_invert_triangle,) = get_lapack_funcs(("trtri",), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SymmetricFactor:
    """Factors L D L' of a system of N unknowns, which come in another order.

    offsets (N + 1,), rows (M,), lower (M,): columns of L, unit lower triangular, rows ascending. diagonal: (N,) of D.
    place: (N,) row of L of each unknown.
    """

    offsets: Ints
    rows: NDArray[np.int32]
    lower: Floats
    diagonal: Floats
    place: Ints

    def compute_diagonal_blocks(self, count: int) -> Floats:
        """Compute the first diagonal blocks (count, 3, 3) of the inverse of the system."""
        out = np.empty((count, 3, 3))
        _gather_blocks(self.place, self.offsets, self.rows, _invert_on_pattern(self), out)
        return out


def solve_by_factors(matrix: csc_array, right_side: Floats) -> tuple[Floats, SymmetricFactor]:
    """Solve a symmetric positive definite system, and return its factors, too."""
    solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    found, lower, place = solver.solve(right_side), solver.L, np.asarray(solver.perm_r, np.int64)
    # It holds both factors twice, once in a form of its own.
    del solver
    lower.sort_indices()
    offsets, rows, values = _close_pattern(lower.indptr.astype(np.int64), lower.indices, lower.data)
    diagonal = np.empty(len(place))
    # Row place[i] of the factor is row i of the system; columns go alike in symmetric mode.
    diagonal[place] = matrix.diagonal()
    _divide_out(offsets, rows, values, diagonal)
    return found, SymmetricFactor(offsets, rows, values, diagonal, place)


def _close_pattern(offsets: Ints, rows: NDArray[np.int32], lower: Floats) -> tuple[Ints, NDArray[np.int32], Floats]:
    """Return the columns of L with the entries that cancelled, as zeros; see :class:`SymmetricFactor`."""
    if _is_closed(offsets, rows):
        return offsets, rows, lower
    columns = np.split(rows, offsets[1:-1])
    for j in range(len(columns)):
        if len(columns[j]) > 1:
            first = int(columns[j][1])
            columns[first] = np.union1d(columns[first], columns[j][1:])
    closed = np.concatenate(([0], np.cumsum([len(column) for column in columns])))
    values = np.zeros(closed[-1])
    for j, column in enumerate(columns):
        a, b = offsets[j], offsets[j + 1]
        values[closed[j] + np.searchsorted(column, rows[a:b])] = lower[a:b]
    return closed, np.concatenate(columns), values


@njit(cache=True, nogil=True)
def _is_closed(offsets: I64x1, rows: I32x1) -> bool:  # pragma: no cover - compiled
    """Return whether every column's rows below its first one under the diagonal are rows of the column of that one."""
    for j in range(len(offsets) - 1):
        a, b = offsets[j] + 1, offsets[j + 1]
        if a == b:
            continue
        k, end = offsets[rows[a]], offsets[rows[a] + 1]
        for m in range(a, b):
            while k < end and rows[k] < rows[m]:
                k += 1
            if k == end or rows[k] != rows[m]:
                return False
    return True


def _invert_on_pattern(factor: SymmetricFactor) -> Floats:
    """Compute the inverse at the entries (M,) of L."""
    offsets, rows, lower = factor.offsets, factor.rows, factor.lower
    out, local = np.empty(len(lower)), np.full(len(factor.diagonal), -1)
    begins = _find_alike(offsets, rows, _MAX_COLUMNS)
    for begin, end in zip(begins[-2::-1].tolist(), begins[:0:-1].tolist()):
        columns = _cut_columns(begin, end, offsets, lower)
        below = rows[offsets[end - 1] + 1 : offsets[end]]
        width = end - begin
        unit_inverse, _ = _invert_triangle(columns[:width], lower=1, unitdiag=1)
        reduced = columns[width:] @ unit_inverse
        block = unit_inverse.T @ (unit_inverse / factor.diagonal[begin:end, None])
        coupled = np.zeros((0, width))
        if len(below):
            coupled = _gather_square(below, offsets, rows, out, local) @ -reduced
            block -= coupled.T @ reduced
        _put_columns(begin, offsets, np.concatenate((block, coupled)), out)
    return out


@njit(cache=True, nogil=True)
def _divide_out(offsets: I64x1, rows: I32x1, lower: F64x1, diagonal: F64x1) -> None:  # pragma: no cover - compiled
    """Turn the diagonal of a symmetric matrix into D of its factors L D L'."""
    for j in range(len(diagonal)):
        for k in range(offsets[j] + 1, offsets[j + 1]):
            diagonal[rows[k]] -= lower[k] * lower[k] * diagonal[j]


@njit(cache=True, nogil=True)
def _find_alike(offsets: I64x1, rows: I32x1, max_columns: int) -> I64x1:  # pragma: no cover - compiled
    """Return where columns begin that have other rows than those before them, and their number at the end."""
    count = len(offsets) - 1
    begins, n = np.zeros(count + 1, np.int64), 1
    for j in range(1, count):
        a, b = offsets[j - 1], offsets[j]
        # The rows of a column below the next one are a part of those of the next one.
        is_alike = b - a == offsets[j + 1] - b + 1 and rows[a + 1] == j
        if not is_alike or j - begins[n - 1] >= max_columns:
            begins[n] = j
            n += 1
    begins[n] = count
    return begins[: n + 1].copy()


@njit(cache=True, nogil=True)
def _cut_columns(begin: int, end: int, offsets: I64x1, lower: F64x1) -> F64x2:  # pragma: no cover - compiled
    """Return the columns of L from begin to end as a table, zero above the diagonal."""
    out = np.zeros((offsets[begin + 1] - offsets[begin], end - begin))
    for j in range(end - begin):
        a = offsets[begin + j]
        for k in range(offsets[begin + j + 1] - a):
            out[j + k, j] = lower[a + k]
    return out


@njit(cache=True, nogil=True)
def _put_columns(begin: int, offsets: I64x1, table: F64x2, out: F64x1) -> None:  # pragma: no cover - compiled
    """Put a table of columns into the entries of L."""
    for j in range(table.shape[1]):
        a = offsets[begin + j]
        for k in range(offsets[begin + j + 1] - a):
            out[a + k] = table[j + k, j]


@njit(cache=True, nogil=True)
def _gather_square(
    below: I32x1, offsets: I64x1, rows: I32x1, values: F64x1, local: I64x1
) -> F64x2:  # pragma: no cover - compiled
    """Gather the values (R, R) at these rows and columns; local: (N,) of -1, which is used in between."""
    out = np.empty((len(below), len(below)))
    for a in range(len(below)):
        local[below[a]] = a
    for a in range(len(below)):
        for k in range(offsets[below[a]], offsets[below[a] + 1]):
            b = local[rows[k]]
            if b >= 0:
                out[a, b] = values[k]
                out[b, a] = values[k]
    for a in range(len(below)):
        local[below[a]] = -1
    return out


@njit(cache=True, nogil=True)
def _gather_blocks(
    place: I64x1, offsets: I64x1, rows: I32x1, values: F64x1, out: F64x3
) -> None:  # pragma: no cover - compiled
    """Gather the blocks (N, 3, 3) on the diagonal; place: row of the factor of each unknown."""
    for o in range(len(out)):
        for i in range(3):
            for j in range(3):
                one, two = place[3 * o + i], place[3 * o + j]
                low, high = min(one, two), max(one, two)
                out[o, i, j] = 0.0
                for k in range(offsets[low], offsets[low + 1]):
                    if rows[k] == high:
                        out[o, i, j] = values[k]
                        break
