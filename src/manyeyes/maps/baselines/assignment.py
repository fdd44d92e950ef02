# SPDX-License-Identifier: Apache-2.0
"""The cheapest assignment of rows to columns (Kuhn 1955, in the shortest-path form of Jonker and Volgenant 1987)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, I64x1, njit
from manyeyes.datatypes.map_element import freeze


def assign(cost: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) the column of each row of cost (N, M), -1 for rows left over; the sum is the least there is. Costs are finite."""
    rows, columns = cost.shape
    if rows == 0 or columns == 0:
        return np.full(rows, -1, np.int64)
    if rows > columns:
        columns_of_rows = assign(cost.T)
        out = np.full(rows, -1, np.int64)
        out[columns_of_rows] = np.arange(columns)
        return out
    return _assign(freeze(cost, np.float64))


@njit(cache=True)
def _assign(cost: F64x2) -> I64x1:  # pragma: no cover - compiled
    rows, columns = cost.shape
    price_row, price_column = np.zeros(rows), np.zeros(columns)
    owner = np.full(columns, -1, np.int64)
    for start in range(rows):
        # The cheapest path from a free row to a free column, by Dijkstra over reduced costs.
        reach = np.full(columns, np.inf)
        before = np.full(columns, -1, np.int64)
        done = np.zeros(columns, np.bool_)
        row, last, passed = start, -1, 0.0
        while True:
            best, found = np.inf, -1
            for column in range(columns):
                if done[column]:
                    continue
                at = passed + cost[row, column] - price_row[row] - price_column[column]
                if at < reach[column]:
                    reach[column], before[column] = at, last
                if reach[column] < best:
                    best, found = reach[column], column
            done[found] = True
            passed, last = best, found
            if owner[found] < 0:
                break
            row = owner[found]
        price_row[start] += passed
        for column in range(columns):
            if done[column] and column != last:
                price_row[owner[column]] += passed - reach[column]
                price_column[column] -= passed - reach[column]
        while last >= 0:
            ahead = before[last]
            owner[last] = owner[ahead] if ahead >= 0 else start
            last = ahead
    out = np.full(rows, -1, np.int64)
    for column in range(columns):
        if owner[column] >= 0:
            out[owner[column]] = column
    return out
