# SPDX-License-Identifier: Apache-2.0
"""The one-to-one assignment of least cost, by shortest augmenting paths; O(n^2 m). Source: Kuhn, Naval Research
Logistics 2, 1955.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, I64x1, njit
from manyeyes.datatypes import ShapeError


def assign(cost: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows and columns (min(N, M), 2) of least total cost (N, M), by row; every row or every column is assigned."""
    if cost.ndim != 2 or not np.isfinite(cost).all():
        raise ShapeError(f"assign needs a finite cost (N, M); got {cost.shape}. Give forbidden pairs a large cost.")
    wide = cost.shape[0] <= cost.shape[1]
    column = _shortest_paths(np.ascontiguousarray(cost if wide else cost.T, np.float64))
    pairs = np.stack((np.arange(len(column)), column), 1)
    return pairs if wide else pairs[np.argsort(pairs[:, 1])][:, ::-1]


@njit(cache=True)
def _shortest_paths(cost: F64x2) -> I64x1:  # pragma: no cover - compiled
    """(N,) the column of each row, N <= M. Column 0 and row 0 of the potentials are a sentinel."""
    n, m = cost.shape
    u, v = np.zeros(n + 1), np.zeros(m + 1)
    owner, way = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.int64)
    for i in range(1, n + 1):
        owner[0] = i
        min_reduced = np.full(m + 1, np.inf)
        done = np.zeros(m + 1, np.bool_)
        here = 0
        while owner[here] != 0:
            done[here] = True
            row, step, there = owner[here], np.inf, 0
            for j in range(1, m + 1):
                if done[j]:
                    continue
                reduced = cost[row - 1, j - 1] - u[row] - v[j]
                if reduced < min_reduced[j]:
                    min_reduced[j], way[j] = reduced, here
                if min_reduced[j] < step:
                    step, there = min_reduced[j], j
            for j in range(m + 1):
                if done[j]:
                    u[owner[j]] += step
                    v[j] -= step
                else:
                    min_reduced[j] -= step
            here = there
        while here != 0:
            owner[here] = owner[way[here]]
            here = way[here]
    column = np.empty(n, np.int64)
    for j in range(1, m + 1):
        if owner[j] > 0:
            column[owner[j] - 1] = j - 1
    return column
