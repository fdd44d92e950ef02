# SPDX-License-Identifier: Apache-2.0
"""The sums of pairs as blocks of the joint system, one for each two observations that share lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x2, F64x3, I64x1, njit, set_row
from manyeyes.maps.fusion.pose_solution import PairSums
from manyeyes.ops._sort_kernels import sort

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Of the upper triangle (xx, xy, xt, yy, yt, tt), the entries of a symmetric matrix in order of rows.
_SYMMETRIC = [0, 1, 2, 1, 3, 4, 2, 4, 5]
# Of what a pair shares, the entries in order of rows of the other observation's block, and of the block between both, negative.
_OTHER = np.array([0, 1, 3, 1, 2, 4, 3, 4, 5])
_BETWEEN = np.array([0, 1, 3, 1, 2, 4, 6, 7, 8])


class PairBlocks(NamedTuple):
    """Sums of all pairs over O observations: own (O, 3, 3), right side (O, 3), and the couplings of each to those in later rows.

    offsets: (O + 1,) of the couplings. other: (M,) rows, ascending for each observation. coupling: (M, 3, 3), which stands at
    (row, other), and transposed at (other, row).
    """

    own: F64x3
    right_side: F64x2
    offsets: I64x1
    other: I64x1
    coupling: F64x3

    @classmethod
    def of_sums(cls, pairs: PairSums, ids: Sequence[str]) -> PairBlocks:
        """Assemble the sums of observations, whose ids ascend; others that they form pairs with stay where they are."""
        # Fixed lengths compare as integers do; ids ascend, so rows are found by bisection.
        digests = np.ascontiguousarray(pairs.other_ids).view("S16").ravel()
        known = np.frombuffer(bytes.fromhex("".join(ids)), "S16")
        found = np.searchsorted(known, digests)
        other = np.where(known[np.minimum(found, len(known) - 1)] == digests, found, -1)
        own, right_side = pairs.own[:, _SYMMETRIC].reshape(-1, 3, 3), pairs.own[:, 6:9].copy()
        _add_others(other, pairs.shared, own, right_side)
        return cls(own, right_side, *_merge_directions(pairs.offsets, other, pairs.shared))

    @property
    def row(self) -> Ints:
        """The row (M,) of each coupling."""
        return np.repeat(np.arange(len(self.own)), np.diff(self.offsets))


@njit(cache=True, nogil=True)
def _add_others(other: I64x1, shared: F64x2, own: F64x3, right_side: F64x2) -> None:  # pragma: no cover - compiled
    """Add what each pair (N,) gives to the other observation to its own block and right side; other: its row, -1 outside."""
    for k in range(len(other)):
        if other[k] >= 0:
            block, right, row = own[other[k]], right_side[other[k]], shared[k]
            for m in range(3):
                right[m] -= row[9 + m]
                for n in range(3):
                    block[m, n] += row[_OTHER[3 * m + n]]


@njit(cache=True, nogil=True)
def _merge_directions(
    offsets: I64x1, other: I64x1, shared: F64x2
) -> tuple[I64x1, I64x1, F64x3]:  # pragma: no cover - compiled
    """Add the blocks of both directions of each pair; returns offsets, other and coupling of :class:`PairBlocks`."""
    count = len(offsets) - 1
    begin = np.zeros(count + 2, np.int64)
    for row in range(count):
        for k in range(offsets[row], offsets[row + 1]):
            if other[k] >= 0:
                begin[min(row, other[k]) + 2] += 1
    for row in range(count):
        begin[row + 2] += begin[row + 1]
    # Pairs by their earlier row, the end of each row being where it is filled; which pair, and its later row.
    pair, later = np.empty(begin[count + 1], np.int64), np.empty(begin[count + 1], np.int64)
    for row in range(count):
        for k in range(offsets[row], offsets[row + 1]):
            if other[k] >= 0:
                low = min(row, other[k]) + 1
                pair[begin[low]], later[begin[low]] = k, max(row, other[k])
                begin[low] += 1
    first, seen = np.zeros(count + 1, np.int64), np.full(count, -1)
    for row in range(count):
        first[row + 1] = first[row]
        for i in range(begin[row], begin[row + 1]):
            if seen[later[i]] != row:
                seen[later[i]] = row
                first[row + 1] += 1
    merged, coupling, place = np.empty(first[count], np.int64), np.zeros((first[count], 3, 3)), np.full(count, -1)
    for row in range(count):
        n = first[row]
        for i in range(begin[row], begin[row + 1]):
            if place[later[i]] < first[row]:
                merged[n] = later[i]
                place[later[i]] = n
                n += 1
        set_row(merged[first[row] : n], sort(merged[first[row] : n]))
        for i in range(first[row], n):
            place[merged[i]] = i
        for i in range(begin[row], begin[row + 1]):
            block, sums = coupling[place[later[i]]], shared[pair[i]]
            if later[i] == other[pair[i]]:
                for m in range(3):
                    for n in range(3):
                        block[m, n] -= sums[_BETWEEN[3 * m + n]]
            else:
                for m in range(3):
                    for n in range(3):
                        block[m, n] -= sums[_BETWEEN[3 * n + m]]
    return first, merged, coupling


@njit(cache=True, nogil=True)
def multiply_couplings(pairs: PairBlocks, vector: F64x2, out: F64x2) -> None:  # pragma: no cover - compiled
    """Add the product of the couplings, in both places of each, and a vector (O, 3) to out (O, 3)."""
    offsets, other, coupling = pairs.offsets, pairs.other, pairs.coupling
    for row in range(len(offsets) - 1):
        x, y, t = vector[row, 0], vector[row, 1], vector[row, 2]
        own_x, own_y, own_t = 0.0, 0.0, 0.0
        for k in range(offsets[row], offsets[row + 1]):
            j = other[k]
            xx, xy, xt = coupling[k, 0, 0], coupling[k, 0, 1], coupling[k, 0, 2]
            yx, yy, yt = coupling[k, 1, 0], coupling[k, 1, 1], coupling[k, 1, 2]
            tx, ty, tt = coupling[k, 2, 0], coupling[k, 2, 1], coupling[k, 2, 2]
            u, v, w = vector[j, 0], vector[j, 1], vector[j, 2]
            own_x += xx * u + xy * v + xt * w
            own_y += yx * u + yy * v + yt * w
            own_t += tx * u + ty * v + tt * w
            out[j, 0] += xx * x + yx * y + tx * t
            out[j, 1] += xy * x + yy * y + ty * t
            out[j, 2] += xt * x + yt * y + tt * t
        out[row, 0] += own_x
        out[row, 1] += own_y
        out[row, 2] += own_t
