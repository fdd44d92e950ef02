# SPDX-License-Identifier: Apache-2.0
"""Gradient of a sparse convolution's weight in one compiled loop, on the CPU: sums of outer products over pairs of rows.

Rows are read where they lie, as in ``_sparse_conv_kernels``. The sums of six inputs and up to 64 outputs stay in registers over a
block of pairs, whose rows stay in the cache for all inputs and outputs. Blocks are summed apart, which keeps rounding errors small.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from manyeyes._jit import F32x2, F32x3, I64x1, njit
from manyeyes.ops._sparse_conv_kernels import LANES
from manyeyes.ops.sparse_index import Pairs

_WIDE = bool(binding.get_host_cpu_features().get("avx512f", False))
"""Registers for 6 x 4 sums of vectors; others hold 6 x 1."""
_BLOCK = 128
"""Pairs of a block."""


class _OuterBlock(NamedTuple):
    """Pairs start … end of rows source (P,) of the inputs and target (P,) of the outputs."""

    source: I64x1
    target: I64x1
    start: int
    end: int


@njit(cache=True, nogil=True)
def sum_outer_products(x: F32x2, dy: F32x2, pairs: Pairs, is_symmetric: bool, out: F32x3) -> None:  # pragma: no cover
    """Add to out[tap] the sum over the tap's pairs p of x[source[p]]^T dy[target[p]].

    x (N, C), dy (M, D), out (taps, C, D), float32 without gaps, D divisible by LANES. is_symmetric: as in ``convolve``, pairs of
    the taps before the middle alone are given.
    """
    source, target, counts = pairs
    if is_symmetric:
        rows = np.arange(x.shape[0])
        _add_taps(x, dy, rows, rows, np.full(1, x.shape[0]), counts.shape[0], 1, out)
    _add_taps(x, dy, source, target, counts, 0, 1, out)
    if is_symmetric:
        _add_taps(x, dy, target, source, counts, 2 * counts.shape[0], -1, out)


@njit(cache=True, nogil=True)
def _add_taps(
    x: F32x2, dy: F32x2, source: I64x1, target: I64x1, counts: I64x1, tap: int, step: int, out: F32x3
) -> None:  # pragma: no cover
    """The same for counts[0] pairs of tap, then counts[1] pairs of tap + step, and so on."""
    at = 0
    for k in range(counts.shape[0]):
        end = at + counts[k]
        for start in range(at, end, _BLOCK):
            block, column = _OuterBlock(source, target, start, min(start + _BLOCK, end)), 0
            while column < dy.shape[1]:
                if _WIDE and column + 4 * LANES <= dy.shape[1]:
                    _add_four(x, dy, block, column, out[tap])
                    column += 4 * LANES
                elif _WIDE and column + 2 * LANES <= dy.shape[1]:
                    _add_two(x, dy, block, column, out[tap])
                    column += 2 * LANES
                else:
                    _add_one(x, dy, block, column, out[tap])
                    column += LANES
        at, tap = end, tap + step


def _columns(vectors: int) -> Any:
    """What adds the products of a block with so many vectors of outputs from column on."""

    @njit(cache=True, nogil=True)
    def add(x: F32x2, dy: F32x2, block: _OuterBlock, column: int, out: F32x2) -> None:  # pragma: no cover
        source, target, start, end = block
        whole = x.shape[1] // 6 * 6
        for first in range(0, whole, 6):
            _add_tile(6, vectors, x, dy, source, target, start, end, first, column, out)
        rest = x.shape[1] - whole
        if rest >= 4:
            _add_tile(4, vectors, x, dy, source, target, start, end, whole, column, out)
            rest, whole = rest - 4, whole + 4
        if rest >= 2:
            _add_tile(2, vectors, x, dy, source, target, start, end, whole, column, out)
            rest, whole = rest - 2, whole + 2
        if rest >= 1:
            _add_tile(1, vectors, x, dy, source, target, start, end, whole, column, out)

    return add


# One function with so many parameters: an intrinsic takes them one by one, and its code is one piece.
def _tile(
    _: Any,
    rows: Any,
    vectors: Any,
    x: Any,
    dy: Any,
    source: Any,
    target: Any,
    start: Any,
    end: Any,
    first: Any,
    column: Any,
    out: Any,
) -> Any:
    """Add the products of ``rows`` inputs from first on and ``vectors`` x LANES outputs from column on over pairs start … end."""
    kinds = (rows, vectors, x, dy, source, target, start, end, first, column, out)
    vector, place = ir.VectorType(ir.FloatType(), LANES), ir.IntType(64)
    undefined, lane = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        x_, dy_, source_, target_, out_ = (context.make_array(kinds[i])(context, b, given[i]) for i in (2, 3, 4, 5, 10))
        start_, end_, first_, column_ = (given[i] for i in (6, 7, 8, 9))
        inputs, outputs = (cgutils.unpack_tuple(b, array.shape)[1] for array in (x_, dy_))

        def at(array: Any, row: Any, length: Any, offset: Any) -> Any:
            return b.gep(array.data, [b.add(b.mul(row, length), offset)])

        def across(begin: Any) -> list[Any]:
            places = (b.gep(begin, [place(v * LANES)]) for v in range(vectors.literal_value))
            return [b.bitcast(p, vector.as_pointer()) for p in places]

        lines = [across(at(out_, b.add(first_, place(r)), outputs, column_)) for r in range(rows.literal_value)]
        sums = [[cgutils.alloca_once_value(b, ir.Constant(vector, None)) for _ in line] for line in lines]
        with cgutils.for_range_slice(b, start_, end_, place(1)) as (pair, _count):
            ahead = at(x_, b.load(b.gep(source_.data, [pair])), inputs, first_)
            behind = at(dy_, b.load(b.gep(target_.data, [pair])), outputs, column_)
            factors = [b.load(p, align=4) for p in across(behind)]
            for r, totals in enumerate(sums):
                one = b.insert_element(undefined, b.load(b.gep(ahead, [place(r)])), ir.IntType(32)(0))
                many = b.shuffle_vector(one, undefined, lane)
                for factor, total in zip(factors, totals):
                    product = b.fmul(many, factor, flags=["contract"])
                    b.store(b.fadd(product, b.load(total), flags=["contract"]), total)
        for line, totals in zip(lines, sums):
            for p, total in zip(line, totals):
                b.store(b.fadd(b.load(total), b.load(p, align=4)), p, align=4)
        return context.get_dummy_value()

    return types.void(*kinds), generate


_add_tile: Any = intrinsic(prefer_literal=True)(_tile)
_add_one, _add_two, _add_four = _columns(1), _columns(2), _columns(4)
