# SPDX-License-Identifier: Apache-2.0
"""Products of a sparse convolution in one compiled loop: for inference on the CPU.

Rows are read where they lie and added where they lead: nothing is gathered, no product is stored.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_WIDE = 64
# Unsigned places: a signed one might count from the end, and the test for it keeps the loops from vectors.
_ROW, _TWO_ROWS, _THREE_ROWS = np.uintp(_WIDE), np.uintp(2 * _WIDE), np.uintp(3 * _WIDE)
_ONE, _TWO, _THREE = np.uintp(1), np.uintp(2), np.uintp(3)
_FAST = {"contract", "nsz", "arcp", "reassoc"}


@njit(cache=True, nogil=True, fastmath=_FAST)
def add_products(x, weight, source, target, out, inputs, outputs):  # pragma: no cover
    """out[target[p]] += x[source[p]] @ weight for each pair p; x, weight (inputs, outputs), out flat; inputs in fours."""
    sums = np.empty(4 * _WIDE, np.float32)
    pairs, step = source.shape[0], np.uintp(outputs)
    for first in range(0, outputs, _WIDE):
        wide = np.uintp(min(_WIDE, outputs - first))
        for p in range(0, pairs, 4):
            last = pairs - 1
            a, b = np.uintp(source[p] * inputs), np.uintp(source[min(p + 1, last)] * inputs)
            d, e = np.uintp(source[min(p + 2, last)] * inputs), np.uintp(source[min(p + 3, last)] * inputs)
            for c in range(0, inputs, 4):
                u, w = np.uintp(c), np.uintp(c * outputs + first)
                block = (_four(x, a + u), _four(x, b + u), _four(x, d + u), _four(x, e + u))
                _multiply(block, weight, w, step, sums, wide, c == 0)
            for j in range(min(4, pairs - p)):
                to, at = np.uintp(target[p + j] * outputs + first), np.uintp(j * _WIDE)
                for i in range(wide):
                    out[to + i] += sums[at + i]


@njit(cache=True, nogil=True)
def _four(x, at):  # pragma: no cover
    return x[at], x[at + _ONE], x[at + _TWO], x[at + _THREE]


@njit(cache=True, nogil=True, fastmath=_FAST)
def _multiply(block, x, s, step, out, wide, is_first):  # pragma: no cover
    (a0, a1, a2, a3), (b0, b1, b2, b3), (d0, d1, d2, d3), (e0, e1, e2, e3) = block
    s1, s2, s3 = s + step, s + step + step, s + step + step + step
    if is_first:
        for i in range(wide):
            w, y, z, t = x[s + i], x[s1 + i], x[s2 + i], x[s3 + i]
            out[i] = a0 * w + a1 * y + a2 * z + a3 * t
            out[_ROW + i] = b0 * w + b1 * y + b2 * z + b3 * t
            out[_TWO_ROWS + i] = d0 * w + d1 * y + d2 * z + d3 * t
            out[_THREE_ROWS + i] = e0 * w + e1 * y + e2 * z + e3 * t
    else:
        for i in range(wide):
            w, y, z, t = x[s + i], x[s1 + i], x[s2 + i], x[s3 + i]
            out[i] += a0 * w + a1 * y + a2 * z + a3 * t
            out[_ROW + i] += b0 * w + b1 * y + b2 * z + b3 * t
            out[_TWO_ROWS + i] += d0 * w + d1 * y + d2 * z + d3 * t
            out[_THREE_ROWS + i] += e0 * w + e1 * y + e2 * z + e3 * t
