# SPDX-License-Identifier: Apache-2.0
"""Order of tokens by their windows, in compiled loops on the CPU."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import I64x1, njit
from manyeyes.ops._sort_kernels import argsort

_BITS = 20
"""Bits of a window's column in its number (``window_attention.window_ids``)."""
_SPARSE = 8
"""With more than so many possible windows a token, numbers are compared instead of counted."""


@njit(cache=True, nogil=True)
def order_windows(window: I64x1) -> I64x1:  # pragma: no cover
    """Return the order (N,) of tokens by window (N,), stable: a counting sort where windows lie close together."""
    n, mask = window.shape[0], (1 << _BITS) - 1
    if n == 0:
        return np.empty(0, np.int64)
    first_line, last_line = window[0] >> _BITS, window[0] >> _BITS
    first, last = window[0] & mask, window[0] & mask
    for w in window:
        first_line, last_line = min(first_line, w >> _BITS), max(last_line, w >> _BITS)
        first, last = min(first, w & mask), max(last, w & mask)
    columns, lines = last - first + 1, last_line - first_line + 1
    if lines > (_SPARSE * n + 64) // columns:
        return argsort(window)
    place, order = np.zeros(lines * columns + 1, np.int64), np.empty(n, np.int64)
    for w in window:
        place[((w >> _BITS) - first_line) * columns + (w & mask) - first + 1] += 1
    for k in range(lines * columns):
        place[k + 1] += place[k]
    for i in range(n):
        at = ((window[i] >> _BITS) - first_line) * columns + (window[i] & mask) - first
        order[place[at]] = i
        place[at] += 1
    return order


@njit(cache=True, nogil=True)
def sort_windows(window: I64x1) -> tuple[I64x1, I64x1]:  # pragma: no cover
    """Return the order (N,) of tokens by window (N,), and where each window begins in it, and N."""
    order = order_windows(window)
    start, runs = np.empty(window.shape[0] + 1, np.int64), 0
    for i in range(window.shape[0]):
        if i == 0 or window[order[i]] != window[order[i - 1]]:
            start[runs] = i
            runs += 1
    start[runs] = window.shape[0]
    return order, start[: runs + 1]
