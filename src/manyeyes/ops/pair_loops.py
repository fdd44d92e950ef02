# SPDX-License-Identifier: Apache-2.0
"""Products of a sparse convolution in one compiled loop, on the CPU.

Rows are read where they lie and added where they lead: nothing is gathered, no product is stored. The sums of six pairs and
up to 64 outputs stay in registers over all inputs, so that the loop runs at the rate of the multipliers, whatever the
number of channels. Loops that a compiler turns into vectors by itself keep such sums in memory, at less than half of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
"""Outputs come in so many at once."""
# AVX-512 has registers for 6 x 4 sums of 16 lanes; others hold 6 x 1, in two to four registers each.
_FOUR = bool(binding.get_host_cpu_features().get("avx512f", False))


@njit(cache=True, nogil=True)
def convolve(x, weight, bias, source, target, counts, is_symmetric, out):  # pragma: no cover
    """out[target[p]] = bias + the sum of x[source[p]] @ weight[tap] over pairs p, counts (taps,) of each tap from 0 on.

    is_symmetric: the middle tap leads from each row to itself, and taps behind it have the pairs of those before it, which
    alone are given, turned round, the last tap those of the first.
    """
    for o in range(out.shape[0]):
        out[o] = bias
    if is_symmetric:
        rows = np.arange(x.shape[0])
        add_products(x, weight, counts.shape[0], 1, rows, rows, np.full(1, x.shape[0]), out)
    add_products(x, weight, 0, 1, source, target, counts, out)
    if is_symmetric:
        add_products(x, weight, 2 * counts.shape[0], -1, target, source, counts, out)


@njit(cache=True, nogil=True)
def add_products(x, weight, tap, step, source, target, counts, out):  # pragma: no cover
    """out[target[p]] += x[source[p]] @ weight[tap] for each pair p; after counts[0] pairs tap goes on by step, and so on.

    x (N, C), weight (taps, C, D), out (M, D), float32 without gaps, D divisible by LANES; source, target: int64.
    """
    at, outputs = 0, out.shape[1]
    for n in counts:
        matrix, sixes, end, column = weight[tap], at + n // 6 * 6, at + n, 0
        while column < outputs:
            if _FOUR and outputs - column >= 4 * LANES:
                for p in range(at, sixes, 6):
                    _add_tile(6, 4, x, matrix, out, source, target, p, column)
                for p in range(sixes, end):
                    _add_tile(1, 4, x, matrix, out, source, target, p, column)
                column += 4 * LANES
            elif _FOUR and outputs - column >= 2 * LANES:
                for p in range(at, sixes, 6):
                    _add_tile(6, 2, x, matrix, out, source, target, p, column)
                for p in range(sixes, end):
                    _add_tile(1, 2, x, matrix, out, source, target, p, column)
                column += 2 * LANES
            else:
                for p in range(at, sixes, 6):
                    _add_tile(6, 1, x, matrix, out, source, target, p, column)
                for p in range(sixes, end):
                    _add_tile(1, 1, x, matrix, out, source, target, p, column)
                column += LANES
        at, tap = end, tap + step


def _tile(
    _: Any, rows: Any, vectors: Any, x: Any, matrix: Any, out: Any, source: Any, target: Any, pair: Any, column: Any
) -> Any:
    """The products of ``rows`` pairs, from pair on, with ``vectors`` x LANES columns of a matrix, from column on.

    Written for LLVM in vectors, because numba has no name for a vector that stays in a register.
    """
    given_types = (rows, vectors, x, matrix, out, source, target, pair, column)
    vector, place = ir.VectorType(ir.FloatType(), LANES), ir.IntType(64)
    undefined, first = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        x_, matrix_, out_, source_, target_ = (
            context.make_array(kind)(context, b, value) for kind, value in zip(given_types[2:7], given[2:7])
        )
        inputs, outputs = (cgutils.unpack_tuple(b, array.shape)[1] for array in (x_, out_))

        def row(array: Any, names: Any, r: int, width: Any) -> Any:
            name = b.load(b.gep(names.data, [b.add(given[7], place(r))]))
            return b.gep(array.data, [b.mul(name, width)])

        def across(start: Any) -> list[Any]:
            places = (b.gep(start, [b.add(given[8], place(v * LANES))]) for v in range(vectors.literal_value))
            return [b.bitcast(p, vector.as_pointer()) for p in places]

        sources = [row(x_, source_, r, inputs) for r in range(rows.literal_value)]
        targets = [across(row(out_, target_, r, outputs)) for r in range(rows.literal_value)]
        sums = [[cgutils.alloca_once_value(b, ir.Constant(vector, None)) for _ in line] for line in targets]
        with cgutils.for_range(b, inputs) as loop:
            factors = [b.load(p, align=4) for p in across(b.gep(matrix_.data, [b.mul(loop.index, outputs)]))]
            for start, totals in zip(sources, sums):
                one = b.insert_element(undefined, b.load(b.gep(start, [loop.index])), ir.IntType(32)(0))
                many = b.shuffle_vector(one, undefined, first)
                for factor, total in zip(factors, totals):
                    product = b.fmul(many, factor, flags=["contract"])
                    b.store(b.fadd(product, b.load(total), flags=["contract"]), total)
        for line, totals in zip(targets, sums):
            for p, total in zip(line, totals):
                b.store(b.fadd(b.load(p, align=4), b.load(total)), p, align=4)
        return context.get_dummy_value()

    return types.void(*given_types), generate


_add_tile: Any = intrinsic(prefer_literal=True)(_tile)
