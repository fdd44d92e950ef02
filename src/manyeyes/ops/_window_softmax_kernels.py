# SPDX-License-Identifier: Apache-2.0
"""Attention of tokens to those of their window, in compiled loops whose sums stay in registers, on the CPU.

Queries lie along the vectors, LANES at once, so that scores and softmax need no sum across one. Scores take the queries turned
round, which then stay in registers over all keys; values are mixed row by row as they lie. Both are written for LLVM in vectors:
rows of a head are so short that calls and copies for each product would cost more than the products.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from manyeyes._jit import F32x1, I64x1, Uintpx1, njit
from manyeyes.ops._sparse_conv_kernels import HAS_WIDE_TILES, LANES

FAST = {"contract", "nsz", "nnan", "ninf", "arcp", "reassoc"}
_KEYS = 8 if HAS_WIDE_TILES else 2
"""Scores of so many keys at once stay in registers."""
_MIXED = LANES if HAS_WIDE_TILES else 4
"""Mixtures of so many queries at once stay in registers."""
_BLOCK = np.uintp(LANES)
# 2^f on [-1/2, 1/2]: the least squares of the relative error at 2000 Chebyshev nodes.
_POWERS = tuple(
    map(np.float32, (1, 0.693147206, 0.240226466, 0.05550329, 0.00961851953, 0.00133998604, 0.000153375768))
)


class _Windows(NamedTuple):
    """Tokens (N,) window by window and where each begins, of queries and of keys."""

    order: I64x1
    start: I64x1
    key_order: I64x1
    key_start: I64x1


@njit(cache=True, nogil=True)
def attend(
    q: F32x1, k: F32x1, v: F32x1, out: F32x1, heads: int, width: int, order: I64x1, start: I64x1
) -> None:  # pragma: no cover
    """Window by window and head by head, as many queries at once as a vector holds."""
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
    """As :func:`attend`, of queries to other tokens; both have the same windows, none of them empty. out may be q."""
    scale, windows = np.float32(math.log2(math.e) / math.sqrt(width)), _Windows(order, start, key_order, key_start)
    broad = (width + LANES - 1) // LANES * LANES
    if broad == width:
        _attend_blocks(q, k, v, out, heads, width, scale, windows)
        return
    queries, keys, values = _widen(q, width, broad), _widen(k, width, broad), _widen(v, width, broad)
    _attend_blocks(queries, keys, values, queries, heads, broad, scale, windows)
    for i in range(out.shape[0] // width):
        for c in range(width):
            out[i * width + c] = queries[i * broad + c]


@njit(cache=True, nogil=True)
def _widen(x: F32x1, width: int, broad: int) -> F32x1:  # pragma: no cover
    """Return rows of width numbers as rows of broad ones, with zeros behind."""
    out = np.zeros(x.shape[0] // width * broad, np.float32)
    for i in range(x.shape[0] // width):
        for c in range(width):
            out[i * broad + c] = x[i * width + c]
    return out


@njit(cache=True, nogil=True)
def _attend_blocks(
    q: F32x1,
    k: F32x1,
    v: F32x1,
    out: F32x1,
    heads: int,
    width: int,
    scale: np.float32,
    windows: _Windows,
) -> None:  # pragma: no cover
    """As :func:`attend_across`, of a width divisible by LANES; scale: of the products of queries and keys."""
    order, start, key_order, key_start = windows
    room = _KEYS
    for w in range(key_start.shape[0] - 1):
        room = max(room, (key_start[w + 1] - key_start[w] + _KEYS - 1) // _KEYS * _KEYS)
    # Of LANES queries, and behind them of the keys.
    rows = np.empty(LANES + room, np.uintp)
    # A row for each key, with a column for each query; a row for each query.
    weights, mixed = np.empty(room * LANES, np.float32), np.empty(LANES * LANES, np.float32)
    sums = np.empty(LANES, np.float32)
    for w in range(start.shape[0] - 1):
        m = key_start[w + 1] - key_start[w]
        padded = (m + _KEYS - 1) // _KEYS * _KEYS
        for h in range(heads):
            first = np.uintp(h * width)
            for j in range(padded):
                rows[LANES + j] = np.uintp(key_order[key_start[w] + min(j, m - 1)] * heads * width) + first
            for begin in range(start[w], start[w + 1], LANES):
                count = min(start[w + 1] - begin, LANES)
                for i in range(LANES):
                    rows[i] = np.uintp(order[begin + min(i, count - 1)] * heads * width) + first
                for c in range(0, width, LANES):
                    _score(q, k, rows, c, scale, padded, weights)
                _exponentiate_columns(weights, m, sums)
                for c in range(0, width, LANES):
                    for i in range(0, LANES, _MIXED):
                        _mix(weights, m, i, v, rows, c, mixed)
                    _store(mixed, sums, rows, count, c, out)


@njit(cache=True, nogil=True, fastmath=FAST)
def _store(mixed: F32x1, sums: F32x1, rows: Uintpx1, count: int, column: int, out: F32x1) -> None:  # pragma: no cover
    """out[rows[i] + column + c] = mixed[i, c] / sums[i] of count rows."""
    for i in range(np.uintp(count)):
        to, share = rows[i] + np.uintp(column), np.float32(1.0) / sums[i]
        for c in range(_BLOCK):
            out[to + c] = mixed[i * _BLOCK + c] * share


_VECTOR, _PLACE = ir.VectorType(ir.FloatType(), LANES), ir.IntType(64)


def _vector_at(b: Any, array: Any, index: Any) -> Any:
    """Return the pointer to LANES numbers of an array from index on."""
    return b.bitcast(b.gep(array, [index]), _VECTOR.as_pointer())


def _spread(b: Any, pointer: Any) -> Any:
    """Return the number at a pointer in all lanes."""
    undefined, first = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    return b.shuffle_vector(b.insert_element(undefined, b.load(pointer), ir.IntType(32)(0)), undefined, first)


def _add_product(b: Any, total: Any, one: Any, other: Any) -> None:
    """Add the product of two vectors to that at a pointer."""
    b.store(b.fadd(b.fmul(one, other, flags=["contract"]), b.load(total), flags=["contract"]), total)


def _turn(b: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of LANES vectors: quarters, eighths ... change places."""
    size = 1
    while size < LANES:
        turned = list(rows)
        for i in range(LANES):
            if not i & size:
                low = [LANES + j - size if j & size else j for j in range(LANES)]
                high = [LANES + j if j & size else j + size for j in range(LANES)]
                for to, lanes in ((i, low), (i + size, high)):
                    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes)
                    turned[to] = b.shuffle_vector(rows[i], rows[i + size], mask)
        rows, size = turned, 2 * size
    return rows


def _make_score(_: Any, q: Any, k: Any, rows: Any, column: Any, scale: Any, count: Any, out: Any) -> Any:
    """out (count, LANES) = products of k[rows[LANES + j] + c] and q[rows[i] + c] * scale over LANES columns c from column on.

    They are added to out unless column is 0. count: a multiple of _KEYS.
    """
    kinds = (q, k, rows, column, scale, count, out)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        q_, k_, rows_, out_ = (context.make_array(kinds[i])(context, b, given[i]).data for i in (0, 1, 2, 6))
        column_, scale_, count_ = given[3:6]
        starts = [b.add(b.load(b.gep(rows_, [_PLACE(i)])), column_) for i in range(LANES)]
        factor = cgutils.alloca_once(b, ir.FloatType())
        b.store(scale_, factor)
        many = _spread(b, factor)
        queries = [b.fmul(x, many) for x in _turn(b, [b.load(_vector_at(b, q_, s), align=4) for s in starts])]
        is_first = b.icmp_signed("==", column_, _PLACE(0))
        sums = [cgutils.alloca_once(b, _VECTOR) for _ in range(_KEYS)]
        with cgutils.for_range_slice(b, _PLACE(0), count_, _PLACE(_KEYS), _PLACE) as (at, _):
            named = (b.load(b.gep(rows_, [b.add(at, _PLACE(LANES + j))])) for j in range(_KEYS))
            keys = [b.gep(k_, [b.add(row, column_)]) for row in named]
            places = [_vector_at(b, out_, b.mul(b.add(at, _PLACE(j)), _PLACE(LANES))) for j in range(_KEYS)]
            for total, place in zip(sums, places):
                b.store(b.select(is_first, ir.Constant(_VECTOR, None), b.load(place, align=4)), total)
            for c, query in enumerate(queries):
                for total, key in zip(sums, keys):
                    _add_product(b, total, _spread(b, b.gep(key, [_PLACE(c)])), query)
            for total, place in zip(sums, places):
                b.store(b.load(total), place, align=4)
        return context.get_dummy_value()

    return types.void(q, k, rows, types.intp, types.float32, types.intp, out), generate


def _make_mix(_: Any, weights: Any, count: Any, first: Any, v: Any, rows: Any, column: Any, out: Any) -> Any:
    """out (LANES, LANES), _MIXED rows from first on = the sums of weights[j, i] * v[rows[LANES + j] + column + c] over keys j."""
    kinds = (weights, count, first, v, rows, column, out)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        weights_, v_, rows_, out_ = (context.make_array(kinds[i])(context, b, given[i]).data for i in (0, 3, 4, 6))
        count_, first_, column_ = given[1], given[2], given[5]
        sums = [cgutils.alloca_once(b, _VECTOR) for _ in range(_MIXED)]
        for total in sums:
            b.store(ir.Constant(_VECTOR, None), total)
        with cgutils.for_range(b, count_) as loop:
            row = b.load(b.gep(rows_, [b.add(loop.index, _PLACE(LANES))]))
            value = b.load(_vector_at(b, v_, b.add(row, column_)), align=4)
            start = b.gep(weights_, [b.add(b.mul(loop.index, _PLACE(LANES)), first_)])
            for i, total in enumerate(sums):
                _add_product(b, total, _spread(b, b.gep(start, [_PLACE(i)])), value)
        for i, total in enumerate(sums):
            b.store(b.load(total), _vector_at(b, out_, b.mul(b.add(first_, _PLACE(i)), _PLACE(LANES))), align=4)
        return context.get_dummy_value()

    return types.void(weights, types.intp, types.intp, v, rows, types.intp, out), generate


_score: Any = intrinsic(_make_score)
_mix: Any = intrinsic(_make_mix)


def _make_exponentials(_: Any, x: Any, rows: Any, sums: Any) -> Any:
    """x (rows, LANES) becomes 2^(x - its column's largest); sums: of the columns. As by ``power_of_two``.

    Written for LLVM in vectors: a compiler that does not know x and sums apart leaves such a loop to single numbers.
    """
    words = ir.VectorType(ir.IntType(32), LANES)
    fast = ["contract", "nsz", "nnan", "ninf"]

    def constant(value: Any) -> Any:
        return ir.Constant(_VECTOR, [float(value)] * LANES)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        data, to = (context.make_array(kind)(context, b, given[i]).data for i, kind in ((0, x), (2, sums)))
        count, stride = given[1], _PLACE(LANES)
        rint = cgutils.get_or_insert_function(b.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.rint.v{LANES}f32")

        def larger(one: Any, other: Any) -> Any:
            return b.select(b.fcmp_ordered(">", one, other, flags=fast), one, other)

        def power(value: Any) -> Any:
            value = larger(value, constant(-126.0))
            whole = b.call(rint, [value])
            part, result = b.fsub(value, whole, flags=fast), constant(_POWERS[6])
            for n in (5, 4, 3, 2, 1, 0):
                result = b.fadd(b.fmul(result, part, flags=fast), constant(_POWERS[n]), flags=fast)
            shift, bias = (ir.Constant(words, [n] * LANES) for n in (23, 127))
            scale = b.bitcast(b.shl(b.add(b.fptosi(whole, words), bias), shift), _VECTOR)
            return b.fmul(result, scale, flags=fast)

        top, total = cgutils.alloca_once(b, _VECTOR), cgutils.alloca_once(b, _VECTOR)
        b.store(b.load(_vector_at(b, data, _PLACE(0)), align=4), top)
        b.store(constant(0.0), total)
        with cgutils.for_range(b, count) as loop:
            row = _vector_at(b, data, b.mul(loop.index, stride))
            b.store(larger(b.load(row, align=4), b.load(top)), top)
        with cgutils.for_range(b, count) as loop:
            row = _vector_at(b, data, b.mul(loop.index, stride))
            value = power(b.fsub(b.load(row, align=4), b.load(top), flags=fast))
            b.store(value, row, align=4)
            b.store(b.fadd(b.load(total), value, flags=fast), total)
        b.store(b.load(total), _vector_at(b, to, _PLACE(0)), align=4)
        return context.get_dummy_value()

    return types.void(x, types.intp, sums), generate


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
