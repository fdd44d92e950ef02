# SPDX-License-Identifier: Apache-2.0
"""Products of a sparse convolution in one compiled loop, on the CPU.

Rows are read where they lie and added where they lead: nothing is gathered, no product is stored. The sums of six pairs and
up to 64 outputs stay in registers over all inputs, so that the loop runs at the rate of the multipliers, whatever the
number of channels. Loops that a compiler turns into vectors by itself keep such sums in memory, at less than half of it.
Matrices lie in panels of so many columns, in the order in which they are read; while one is multiplied by, the next is
fetched, a little with each tile: those of a layer of 256 channels come from beyond the second cache, and on few rows the wait
would be a third of the time.

Where the processor multiplies pairs of bfloat16 with float32 sums (AVX512-BF16), panels may hold such pairs: two inputs in one
word of 32 bits, rows likewise, at twice the rate. Rows are rounded once a call.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload
from numpy.typing import NDArray
from torch import Tensor

from manyeyes._jit import F32x1, F32x2, F32x4, I32x2, I64x1, njit, set_row
from manyeyes.ops.sparse_index import Pairs

LANES = 16
"""Outputs come in so many at once."""
# AVX-512 has registers for 6 x 4 sums of 16 lanes; others hold 6 x 1, in two to four registers each.
_WIDEST = 4 * LANES if binding.get_host_cpu_features().get("avx512f", False) else LANES
_AHEAD = 2048
"""So many bytes ahead a panel is fetched from the second cache: some hundred cycles of products."""
_LINE = 64
"""Bytes of a line of the cache."""
HAS_WIDE_TILES = _WIDEST > LANES
"""Whether the sums of a tile of 6 x 4 vectors stay in registers."""
HAS_BFLOAT16 = bool(HAS_WIDE_TILES and binding.get_host_cpu_features().get("avx512bf16", False))
"""Whether this processor has products of bfloat16."""
_FRACTION = 1024
"""Shares of bytes are counted in such fractions."""
_MANY, _NEAR = 600, 8192
"""From so many pairs on, with so many numbers in a panel at most, it stays in the first cache, and fetching costs more."""


class _PairRun(NamedTuple):
    """Pairs start … end of rows source (P,) that lead to rows target (P,)."""

    source: I64x1
    target: I64x1
    start: int
    end: int


def panels(taps: Tensor, in_bfloat16: bool = False) -> NDArray[Any]:
    """Matrices (taps, C, D), D divisible by LANES, cut into columns as wide as a tile: (taps, D / width, C, width) in a row.

    in_bfloat16: pairs of inputs as bfloat16 in int32 words, (taps, D / width, C / 2, width); HAS_BFLOAT16 must hold to multiply.
    """
    width = math.gcd(taps.shape[2], _WIDEST)
    cut = taps.unflatten(2, (-1, width)).transpose(1, 2)
    if not in_bfloat16:
        return cut.contiguous().numpy()
    even = torch.nn.functional.pad(cut, (0, 0, 0, cut.shape[2] % 2)).unflatten(2, (-1, 2))
    return even.transpose(3, 4).to(torch.bfloat16).contiguous().view(torch.int32)[..., 0].contiguous().numpy()


@njit(cache=True, nogil=True)
def empty_rows(rows: int, columns: int) -> F32x2:  # pragma: no cover
    """Return (rows, columns) float32 that begins with a line of the cache: a vector across two lines is read twice."""
    spare = _LINE // 4
    flat = np.empty(rows * columns + spare, np.float32)
    start = -(flat.ctypes.data // 4) % spare
    return flat[start : start + rows * columns].reshape(rows, columns)


@njit(cache=True, nogil=True)
def round_rows(x: F32x2) -> I32x2:  # pragma: no cover
    """Return rows (N, C) as pairs of bfloat16 (N, C / 2), rounded to nearest, ties to even; an odd last input has a partner 0."""
    n, channels = x.shape
    half = (channels + 1) // 2
    out, bits = empty_rows(n, half).view(np.int32), x.view(np.uint32)
    for i in range(n):
        row, to = bits[i], out[i]
        for k in range(np.uintp(channels // 2)):
            low, high = _round(row[np.uintp(2) * k]), _round(row[np.uintp(2) * k + np.uintp(1)])
            to[k] = np.int32(low >> np.uint32(16) | high & np.uint32(0xFFFF0000))
        if channels % 2:
            to[half - 1] = np.int32(_round(row[channels - 1]) >> np.uint32(16))
    return out


@njit(cache=True, nogil=True)
def _round(bits: np.uint32) -> np.uint32:  # pragma: no cover
    """Return a float32 whose upper half is the nearest bfloat16."""
    return np.uint32(bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1)))


def _as_factors(x: Any, weight: Any) -> Any:
    """Return rows as the panels of a weight hold their inputs."""
    raise NotImplementedError


@overload(_as_factors)
def _overload_as_factors(x: Any, weight: Any) -> Any:
    def rounded(x: Any, weight: Any) -> Any:
        return round_rows(x)

    def unchanged(x: Any, weight: Any) -> Any:
        return x

    return rounded if x.dtype == types.float32 and weight.dtype == types.int32 else unchanged


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def convolve(
    x: F32x2, weight: F32x4, bias: F32x1, pairs: Pairs, is_symmetric: bool, is_rectified: bool, out: F32x2
) -> None:  # pragma: no cover
    """out[target[p]] = bias + the sum of x[source[p]] @ weight[tap] over pairs p, tap by tap from 0 on.

    weight: :func:`panels`. is_symmetric: the middle tap leads from each row to itself, and taps behind it have the pairs of
    those before it, which alone are given, turned round, the last tap those of the first. is_rectified: below 0 it is 0.
    """
    source, target, counts = pairs
    for o in range(out.shape[0]):
        set_row(out[o], bias)
    factors = _as_factors(x, weight)
    if is_symmetric:
        rows = np.arange(x.shape[0])
        add_products(factors, weight, counts.shape[0], 1, rows, rows, np.full(1, x.shape[0]), out)
    add_products(factors, weight, 0, 1, source, target, counts, out)
    if is_symmetric:
        add_products(factors, weight, 2 * counts.shape[0], -1, target, source, counts, out)
    if is_rectified:
        flat = out.reshape(-1)
        for i in range(np.uintp(flat.shape[0])):
            flat[i] = max(flat[i], np.float32(0))


@njit(cache=True, nogil=True)
def add_products(
    x: F32x2, weight: F32x4, tap: int, step: int, source: I64x1, target: I64x1, counts: I64x1, out: F32x2
) -> None:  # pragma: no cover
    """out[target[p]] += x[source[p]] @ weight[tap] for each pair p; after counts[0] pairs tap goes on by step, and so on.

    x (N, C), weight (taps, D / width, C, width), out (M, D), float32 without gaps; source, target: int64, a tap's target
    never the same twice. weight, and x too, may hold pairs of bfloat16.
    """
    factors = _as_factors(x, weight)
    at, last = 0, counts.shape[0] - 1
    for k in range(last + 1):
        end = at + counts[k]
        run = _PairRun(source, target, at, end)
        for q in range(weight.shape[1]):
            panel, column, following = weight[tap, q], q * weight.shape[3], weight[tap, q]
            if q + 1 < weight.shape[1]:
                following = weight[tap, q + 1]
            elif k < last:
                following = weight[tap + step, 0]
            if weight.shape[3] == 4 * LANES:
                _add_four(factors, panel, following, run, column, out)
            elif weight.shape[3] == 2 * LANES:
                _add_two(factors, panel, following, run, column, out)
            else:
                _add_one(factors, panel, following, run, column, out)
        at, tap = end, tap + step


def _panel(vectors: int) -> Any:
    """What adds the products of a run of pairs with one panel of so many vectors, from column on of the outputs."""

    @njit(cache=True, nogil=True)
    def add(
        x: F32x2, panel: F32x2, following: F32x2, run: _PairRun, column: int, out: F32x2
    ) -> None:  # pragma: no cover
        source, target, at, end = run
        sixes, tiles = at + (end - at) // 6 * 6, (end - at + 5) // 6
        # Every input of every tile fetches its share of the panel that follows, in fractions of a byte.
        share, fetched = 4 * vectors * LANES * _FRACTION // max(tiles, 1), 0
        if end - at >= _MANY and panel.size <= _NEAR:
            for p in range(at, sixes, 6):
                add_tile(6, vectors, False, x, panel, following, fetched, share, source, target, p, column, out)
        else:
            for p in range(at, sixes, 6):
                add_tile(6, vectors, True, x, panel, following, fetched, share, source, target, p, column, out)
                fetched += share * x.shape[1]
        rest = end - sixes
        if rest == 5:
            add_tile(5, vectors, True, x, panel, following, fetched, share, source, target, sixes, column, out)
        elif rest == 4:
            add_tile(4, vectors, True, x, panel, following, fetched, share, source, target, sixes, column, out)
        elif rest == 3:
            add_tile(3, vectors, True, x, panel, following, fetched, share, source, target, sixes, column, out)
        elif rest == 2:
            add_tile(2, vectors, True, x, panel, following, fetched, share, source, target, sixes, column, out)
        elif rest == 1:
            add_tile(1, vectors, True, x, panel, following, fetched, share, source, target, sixes, column, out)

    return add


class _BFloat(ir.Type):
    """The type bfloat, for which llvmlite has no name."""

    def _to_string(self) -> str:
        return "bfloat"

    def __str__(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


def _add_dot(b: Any, total: Any, one: Any, other: Any) -> Any:
    """Add to each float of total the products of two pairs of bfloat16."""
    vector, pairs = ir.VectorType(ir.FloatType(), LANES), ir.VectorType(_BFloat(), 2 * LANES)
    kind = ir.FunctionType(vector, [vector, pairs, pairs])
    dot = cgutils.get_or_insert_function(b.module, kind, "llvm.x86.avx512bf16.dpbf16ps.512")
    return b.call(dot, [total, b.bitcast(one, pairs), b.bitcast(other, pairs)])


# One function with so many parameters: an intrinsic takes them one by one, and its code is one piece.
def _tile(
    _: Any,
    rows: Any,
    vectors: Any,
    fetching: Any,
    x: Any,
    panel: Any,
    following: Any,
    fetched: Any,
    share: Any,
    source: Any,
    target: Any,
    pair: Any,
    column: Any,
    out: Any,
) -> Any:
    """Add the products of ``rows`` pairs, from pair on, and a panel of ``vectors`` x LANES columns, from column on of out.

    fetching: whether the panel that follows is brought nearer meanwhile, from fetched on a share for each input.
    Written for LLVM in vectors, because numba has no name for a vector that stays in a register.
    """
    kinds = (rows, vectors, fetching, x, panel, following, fetched, share, source, target, pair, column, out)
    in_pairs = panel.dtype == types.int32
    vector, place, byte = ir.VectorType(ir.FloatType(), LANES), ir.IntType(64), ir.IntType(8).as_pointer()
    factor_type = ir.VectorType(ir.IntType(32), LANES) if in_pairs else vector
    undefined, first = ir.Constant(factor_type, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
    width = place(vectors.literal_value * LANES)

    def generate(context: Any, b: Any, signature: Any, given: Any) -> Any:
        x_, panel_, following_, source_, target_, out_ = (
            context.make_array(kinds[i])(context, b, given[i]) for i in (3, 4, 5, 8, 9, 12)
        )
        fetched_, share_, pair_, column_ = (given[i] for i in (6, 7, 10, 11))
        inputs, outputs = (cgutils.unpack_tuple(b, array.shape)[1] for array in (x_, out_))
        kind = ir.FunctionType(ir.VoidType(), [byte, *[ir.IntType(32)] * 3])
        prefetch = cgutils.get_or_insert_function(b.module, kind, "llvm.prefetch.p0i8")
        to_read_near = [ir.IntType(32)(flag) for flag in (0, 3, 1)]

        def fetch(start: Any, offset: Any) -> None:
            b.call(prefetch, [b.gep(b.bitcast(start, byte), [offset]), *to_read_near])

        def row(array: Any, names: Any, r: int, length: Any) -> Any:
            name = b.load(b.gep(names.data, [b.add(pair_, place(r))]))
            return b.gep(array.data, [b.mul(name, length)])

        def across(start: Any, kind: Any = vector) -> list[Any]:
            places = (b.gep(start, [place(v * LANES)]) for v in range(vectors.literal_value))
            return [b.bitcast(p, kind.as_pointer()) for p in places]

        def add_product(total: Any, many: Any, factor: Any) -> Any:
            if in_pairs:
                return _add_dot(b, total, many, factor)
            return b.fadd(b.fmul(many, factor, flags=["contract"]), total, flags=["contract"])

        sources = [row(x_, source_, r, inputs) for r in range(rows.literal_value)]
        starts = [row(out_, target_, r, outputs) for r in range(rows.literal_value)]
        targets = [across(b.gep(start, [column_])) for start in starts]
        sums = [[cgutils.alloca_once(b, vector) for _ in line] for line in targets]
        for line, totals in zip(targets, sums):
            for p, total in zip(line, totals):
                b.store(b.load(p, align=4), total)
        with cgutils.for_range(b, inputs) as loop:
            places = across(b.gep(panel_.data, [b.mul(loop.index, width)]), factor_type)
            factors = [b.load(p, align=4) for p in places]
            if fetching.literal_value:
                for p in places:
                    fetch(p, place(_AHEAD))
                soon = b.udiv(b.add(fetched_, b.mul(loop.index, share_)), place(_FRACTION))
                fetch(following_.data, b.and_(soon, place(-_LINE)))
            for start, totals in zip(sources, sums):
                one = b.insert_element(undefined, b.load(b.gep(start, [loop.index])), ir.IntType(32)(0))
                many = b.shuffle_vector(one, undefined, first)
                for factor, total in zip(factors, totals):
                    b.store(add_product(b.load(total), many, factor), total)
        for line, totals in zip(targets, sums):
            for p, total in zip(line, totals):
                b.store(b.load(total), p, align=4)
        return context.get_dummy_value()

    return types.void(*kinds), generate


add_tile: Any = intrinsic(prefer_literal=True)(_tile)
_add_one, _add_two, _add_four = _panel(1), _panel(2), _panel(4)
