# SPDX-License-Identifier: Apache-2.0
"""Sorting in compiled loops: numpy's results, by a merge sort that compiles in a tenth of the time of numba's sorts."""

from __future__ import annotations

from typing import Any

import numpy as np

from manyeyes._jit import I64x1, njit

_RUN = 16
"""Values that are sorted by insertion before runs are merged."""


@njit(cache=True, nogil=True)
def argsort(values: Any) -> I64x1:  # pragma: no cover
    """Return the order (N,) of numbers (N,), as ``np.argsort(values, kind="stable")`` does; NaN is last."""
    n = values.shape[0]
    order, merged = np.empty(n, np.int64), np.empty(n, np.int64)
    for low in range(0, n, _RUN):
        for i in range(low, min(low + _RUN, n)):
            j = i
            while j > low and _is_before(values[i], values[order[j - 1]]):
                order[j] = order[j - 1]
                j -= 1
            order[j] = i
    width = _RUN
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            a, b = low, middle
            for k in range(low, high):
                if a < middle and (b == high or not _is_before(values[order[b]], values[order[a]])):
                    merged[k] = order[a]
                    a += 1
                else:
                    merged[k] = order[b]
                    b += 1
        order, merged = merged, order
        width *= 2
    return order


@njit(cache=True, nogil=True)
def sort(values: Any) -> Any:  # pragma: no cover
    """Return numbers (N,) in ascending order, as ``np.sort(values)`` does."""
    order, out = argsort(values), np.empty(values.shape[0], values.dtype)
    for i in range(values.shape[0]):
        out[i] = values[order[i]]
    return out


@njit(cache=True, nogil=True)
def _is_before(one: Any, other: Any) -> bool:  # pragma: no cover
    return one < other or (other != other and one == one)
