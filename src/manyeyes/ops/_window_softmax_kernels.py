# SPDX-License-Identifier: Apache-2.0
"""Attention of tokens to those of their window, in compiled loops whose sums stay in registers, on the CPU.

Queries lie along the vectors, so that scores, softmax and mixture need no sum across one. Both products are tiles of
``_sparse_conv_kernels``; the other loops run over whole vectors of a fixed length, since a compiler cuts a loop of unknown length
into long pieces and leaves windows of few tokens to its slow rest.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from manyeyes._jit import F32x1, F32x2, I64x1, Uintpx1, njit
from manyeyes.ops._sparse_conv_kernels import HAS_WIDE_TILES, LANES, add_tile

FAST = {"contract", "nsz", "nnan", "ninf", "arcp", "reassoc"}
_VECTORS = 4 if HAS_WIDE_TILES else 1
_TILE = _VECTORS * LANES
"""Number of queries at once."""
# 2^f on [-1/2, 1/2]: the least squares of the relative error at 2000 Chebyshev nodes.
_POWERS = tuple(
    map(np.float32, (1, 0.693147206, 0.240226466, 0.05550329, 0.00961851953, 0.00133998604, 0.000153375768))
)


@njit(cache=True, nogil=True)
def attend(
    q: F32x1, k: F32x1, v: F32x1, out: F32x1, heads: int, width: int, order: I64x1, start: I64x1
) -> None:  # pragma: no cover
    """Window by window and head by head, as many queries at once as a tile holds."""
    attend_across(q, k, v, out, heads, width, order, start, order, start)


@njit(cache=True, nogil=True)
def attend_across(
    q: F32x1,
    k: F32x1,
    v: F32x1,
    out: F32x1,
    heads: int,
    width: int,
    order: I64x1,
    start: I64x1,
    key_order: I64x1,
    key_start: I64x1,
) -> None:  # pragma: no cover
    """As :func:`attend`, of queries to other tokens; both have the same windows, none of them empty."""
    max_keys = 1
    for w in range(key_start.shape[0] - 1):
        max_keys = max(max_keys, key_start[w + 1] - key_start[w])
    rows, key_rows = np.empty(_TILE, np.uintp), np.empty(max_keys, np.uintp)
    names = np.arange(max(max_keys, width))
    # With a column for each query.
    queries, mixed = np.empty(width * _TILE, np.float32), np.empty(width * _TILE, np.float32)
    weights, sums = np.empty(max_keys * _TILE, np.float32), np.empty(_TILE, np.float32)
    keys, values = np.empty(max_keys * width, np.float32), np.empty(max_keys * width, np.float32)
    scale = np.float32(math.log2(math.e) / math.sqrt(width))
    for w in range(start.shape[0] - 1):
        m = key_start[w + 1] - key_start[w]
        some_keys, some_values = keys[: m * width].reshape(m, width), values[: m * width].reshape(width, m)
        for h in range(heads):
            first = np.uintp(h * width)
            for j in range(m):
                key_rows[j] = np.uintp(key_order[key_start[w] + j] * heads * width) + first
            _copy(k, key_rows[:m], width, keys)
            _gather(v, key_rows[:m], width, m, np.float32(1.0), values)
            for begin in range(start[w], start[w + 1], _TILE):
                count = min(start[w + 1] - begin, _TILE)
                vectors = (count + LANES - 1) // LANES
                wide = vectors * LANES
                for i in range(count):
                    rows[i] = np.uintp(order[begin + i] * heads * width) + first
                _gather(q, rows[:count], width, wide, scale, queries)
                _multiply(some_keys, names, vectors, queries, weights)
                _exponentials(weights, m, vectors, sums)
                _multiply(some_values, names, vectors, weights, mixed)
                _scatter(mixed, sums, rows[:count], width, wide, out)


@njit(cache=True, nogil=True)
def _copy(x: F32x1, rows: Uintpx1, width: int, out: F32x1) -> None:  # pragma: no cover
    """out[j, c] = x[rows[j] + c] of rows of width numbers."""
    to = np.uintp(0)
    for j in range(np.uintp(rows.shape[0])):
        at = rows[j]
        for c in range(np.uintp(width)):
            out[to + c] = x[at + c]
        to += np.uintp(width)


@njit(cache=True, nogil=True, fastmath=FAST)
def _gather(
    x: F32x1, rows: Uintpx1, width: int, wide: int, scale: np.float32, columns: F32x1
) -> None:  # pragma: no cover
    """columns[c, i] = x[rows[i] + c] * scale of rows of wide numbers, and zeros up to wide."""
    stride = np.uintp(wide)
    for i in range(np.uintp(rows.shape[0])):
        at = rows[i]
        for c in range(np.uintp(width)):
            columns[i + c * stride] = x[at + c] * scale
    if rows.shape[0] < wide:
        for c in range(width):
            columns[c * wide + rows.shape[0] : (c + 1) * wide] = np.float32(0.0)


@njit(cache=True, nogil=True, fastmath=FAST)
def _scatter(columns: F32x1, sums: F32x1, rows: Uintpx1, width: int, wide: int, out: F32x1) -> None:  # pragma: no cover
    """out[rows[i] + c] = columns[c, i] / sums[i]."""
    stride = np.uintp(wide)
    for i in range(np.uintp(rows.shape[0])):
        to, share = rows[i], np.float32(1.0) / sums[i]
        for c in range(np.uintp(width)):
            out[to + c] = columns[i + c * stride] * share


@njit(cache=True, nogil=True)
def _multiply(x: F32x2, names: I64x1, vectors: int, panel: F32x1, out: F32x1) -> None:  # pragma: no cover
    """out (R, vectors * LANES) = x (R, C) @ panel (C, vectors * LANES); names: 0, 1, ... of rows."""
    rows, wide = x.shape[0], vectors * LANES
    matrix, to = panel[: x.shape[1] * wide].reshape(x.shape[1], wide), out[: rows * wide].reshape(rows, wide)
    for o in range(rows):
        to[o] = np.float32(0.0)
    if vectors == 4:
        _add_four(x, matrix, names, to)
    elif vectors == 3:
        _add_three(x, matrix, names, to)
    elif vectors == 2:
        _add_two(x, matrix, names, to)
    else:
        _add_one(x, matrix, names, to)


def _product(vectors: int) -> Any:
    """What adds the rows of x times a matrix of so many vectors."""

    @njit(cache=True, nogil=True)
    def add(x: F32x2, matrix: F32x2, names: I64x1, out: F32x2) -> None:  # pragma: no cover
        sixes = x.shape[0] // 6 * 6
        for p in range(0, sixes, 6):
            add_tile(6, vectors, False, x, matrix, matrix, 0, 0, names, names, p, 0, out)
        rest = x.shape[0] - sixes
        if rest == 5:
            add_tile(5, vectors, False, x, matrix, matrix, 0, 0, names, names, sixes, 0, out)
        elif rest == 4:
            add_tile(4, vectors, False, x, matrix, matrix, 0, 0, names, names, sixes, 0, out)
        elif rest == 3:
            add_tile(3, vectors, False, x, matrix, matrix, 0, 0, names, names, sixes, 0, out)
        elif rest == 2:
            add_tile(2, vectors, False, x, matrix, matrix, 0, 0, names, names, sixes, 0, out)
        elif rest == 1:
            add_tile(1, vectors, False, x, matrix, matrix, 0, 0, names, names, sixes, 0, out)

    return add


_add_one, _add_two, _add_three, _add_four = _product(1), _product(2), _product(3), _product(4)


@njit(cache=True, nogil=True)
def _exponentials(x: F32x1, rows: int, vectors: int, sums: F32x1) -> None:  # pragma: no cover
    """x (rows, wide) becomes 2^(x - its column's largest); sums: (wide,) of the columns."""
    for vector in range(vectors):
        _exponentiate_columns(x, rows, vectors * LANES, vector * LANES, sums)


def _make_exponentials(_: Any, x: Any, rows: Any, wide: Any, first: Any, sums: Any) -> Any:
    """x (rows, wide) and sums, with LANES columns from first on, as ``_exponentials`` by ``power_of_two``.

    Written for LLVM in vectors: a compiler that does not know x and sums apart leaves such a loop to single numbers.
    """
    vector, words = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(ir.IntType(32), LANES)
    fast = ["contract", "nsz", "nnan", "ninf"]

    def constant(value: Any) -> Any:
        return ir.Constant(vector, [float(value)] * LANES)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        data, to = (context.make_array(kind)(context, b, given[i]).data for i, kind in ((0, x), (4, sums)))
        count, stride, start = given[1:4]
        rint = cgutils.get_or_insert_function(b.module, ir.FunctionType(vector, [vector]), f"llvm.rint.v{LANES}f32")

        def at(array: Any, index: Any) -> Any:
            return b.bitcast(b.gep(array, [index]), vector.as_pointer())

        def larger(one: Any, other: Any) -> Any:
            return b.select(b.fcmp_ordered(">", one, other, flags=fast), one, other)

        def power(value: Any) -> Any:
            value = larger(value, constant(-126.0))
            whole = b.call(rint, [value])
            part, result = b.fsub(value, whole, flags=fast), constant(_POWERS[6])
            for n in (5, 4, 3, 2, 1, 0):
                result = b.fadd(b.fmul(result, part, flags=fast), constant(_POWERS[n]), flags=fast)
            shift, bias = (ir.Constant(words, [n] * LANES) for n in (23, 127))
            scale = b.bitcast(b.shl(b.add(b.fptosi(whole, words), bias), shift), vector)
            return b.fmul(result, scale, flags=fast)

        top, total = cgutils.alloca_once(b, vector), cgutils.alloca_once(b, vector)
        b.store(b.load(at(data, start), align=4), top)
        b.store(constant(0.0), total)
        with cgutils.for_range(b, count) as loop:
            row = b.add(start, b.mul(loop.index, stride))
            b.store(larger(b.load(at(data, row), align=4), b.load(top)), top)
        with cgutils.for_range(b, count) as loop:
            row = b.add(start, b.mul(loop.index, stride))
            value = power(b.fsub(b.load(at(data, row), align=4), b.load(top), flags=fast))
            b.store(value, at(data, row), align=4)
            b.store(b.fadd(b.load(total), value, flags=fast), total)
        b.store(b.load(total), at(to, start), align=4)
        return context.get_dummy_value()

    return types.void(x, types.intp, types.intp, types.intp, sums), generate


_exponentiate_columns: Any = intrinsic(_make_exponentials)


@njit(cache=True, nogil=True, fastmath=FAST)
def power_of_two(x: np.float32) -> np.float32:  # pragma: no cover
    """2^x of x <= 0 within 2e-7 of it; below -126 as of -126."""
    x = max(x, np.float32(-126.0))
    whole = np.rint(x)
    f = x - whole
    y = _POWERS[6]
    for n in (5, 4, 3, 2, 1, 0):
        y = y * f + _POWERS[n]
    return y * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
