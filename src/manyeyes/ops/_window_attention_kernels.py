# SPDX-License-Identifier: Apache-2.0
"""Self-attention within windows in compiled loops, on the CPU.

A window costs no call of its own and is padded to whole vectors at most. Queries lie along the vectors, so that scores,
softmax and mixture need no sum across one. Backward computes the scores again and keeps none, as in FlashAttention (Dao et al.
2022, section 3.1). :mod:`manyeyes.ops.window_attention` is the twin of tensor operations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from manyeyes._jit import F32x1, I64x1, Uintpx1, njit
from manyeyes.datatypes import ShapeError
from manyeyes.ops._window_order_kernels import sort_windows
from manyeyes.ops._window_softmax_kernels import FAST, attend, power_of_two

_TILE = 64
_VECTOR = 16
# Unsigned places: a signed one might count from the end, and the test for it keeps the loops from vectors.
_ROW = np.uintp(_TILE)
_ONE, _TWO, _THREE = np.uintp(1), np.uintp(2), np.uintp(3)
_TWO_ROWS, _THREE_ROWS = np.uintp(2 * _TILE), np.uintp(3 * _TILE)
_Four = tuple[np.float32, np.float32, np.float32, np.float32]
_Block = tuple[_Four, _Four, _Four, _Four]


@dataclass(frozen=True, eq=False)
class WindowRuns:
    """order: (N,) int64, tokens window by window; start: (windows + 1,) int64, where each begins."""

    order: Tensor
    start: Tensor


def window_runs(window: Tensor) -> WindowRuns:
    """Return tokens of windows (N,) int64, sorted."""
    order, start = sort_windows(window.numpy())
    return WindowRuns(torch.from_numpy(order), torch.from_numpy(start))


def attend_in_windows(q: Tensor, k: Tensor, v: Tensor, runs: WindowRuns) -> Tensor:
    """softmax(q k^T / sqrt(d)) v of (N, h, d) float32 over the tokens of each window: (N, h, d); d divisible by 4.

    Differentiable once.
    """
    if q.shape[2] % 4 or not q.shape == k.shape == v.shape:
        raise ShapeError(
            f"q, k, v are (N, h, d), d divisible by 4; got {tuple(q.shape)}, {tuple(k.shape)}, {tuple(v.shape)}."
        )
    out: Tensor = _Attend.apply(q, k, v, runs)  # pyright: ignore[reportAssignmentType]
    return out


class _Attend(torch.autograd.Function):
    """Keeps the inputs alone for its backward pass."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, k: Tensor, v: Tensor, runs: WindowRuns) -> Tensor:
        ctx.save_for_backward(q, k, v)
        ctx.runs = runs
        out = torch.empty_like(v, memory_format=torch.contiguous_format)
        q_, k_, v_, out_ = _flat(q, k, v, out)
        attend(q_, k_, v_, out_, q.shape[1], q.shape[2], runs.order.numpy(), runs.start.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        q, k, v = ctx.saved_tensors
        dq, dk, dv = (torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (q, k, v))
        order, start = ctx.runs.order.numpy(), ctx.runs.start.numpy()
        given = _Given(*_flat(q, k, v, grads[0]))
        _attend_backward(given, _Gradients(*_flat(dq, dk, dv)), q.shape[1], q.shape[2], order, start)
        return dq, dk, dv, None


class _Given(NamedTuple):
    """Queries, keys, values, and the gradient of the output, each (N * h * d,)."""

    q: F32x1
    k: F32x1
    v: F32x1
    grad: F32x1


class _Gradients(NamedTuple):
    """Gradients of queries, keys and values, each (N * h * d,)."""

    q: F32x1
    k: F32x1
    v: F32x1


def _flat(*tensors: Tensor) -> list[F32x1]:
    return [t.detach().contiguous().view(-1).numpy() for t in tensors]


@njit(cache=True, nogil=True, fastmath=FAST)
def _gather(
    x: F32x1, rows: Uintpx1, width: int, wide: int, scale: np.float32, columns: F32x1
) -> None:  # pragma: no cover
    """columns[c, i] = x[rows[i] + c] * scale, and zeros up to wide."""
    for i in range(0, rows.shape[0], 4):
        a, b, d, e, at = rows[i], rows[i + 1], rows[i + 2], rows[i + 3], np.uintp(i)
        for c in range(np.uintp(width)):
            to = at + c * _ROW
            w, y, z, t = x[a + c] * scale, x[b + c] * scale, x[d + c] * scale, x[e + c] * scale
            columns[to], columns[to + _ONE], columns[to + _TWO], columns[to + _THREE] = w, y, z, t
    for c in range(width):
        columns[c * _TILE + rows.shape[0] : c * _TILE + wide] = np.float32(0.0)


@njit(cache=True, nogil=True, fastmath=FAST)
def _scores(
    k: F32x1, rows: Uintpx1, queries: F32x1, weights: F32x1, n: int, width: int, wide: int
) -> None:  # pragma: no cover
    """weights (n, wide) = the rows of k (n, width) times queries (width, wide)."""
    for r in range(0, n, 4):
        a, b, d, e = rows[r], rows[r + 1], rows[r + 2], rows[r + 3]
        for c in range(0, width, 4):
            u = np.uintp(c)
            block = (_four(k, a + u), _four(k, b + u), _four(k, d + u), _four(k, e + u))
            _multiply(block, queries, np.uintp(c * _TILE), weights, np.uintp(r * _TILE), np.uintp(wide), c == 0)


@njit(cache=True, nogil=True, fastmath=FAST)
def _mix(
    v: F32x1, rows: Uintpx1, weights: F32x1, mixed: F32x1, n: int, width: int, wide: int
) -> None:  # pragma: no cover
    """mixed (width, wide) = the rows of v (n, width), transposed, times weights (n, wide)."""
    for c in range(0, width, 4):
        u = np.uintp(c)
        for r in range(0, n, 4):
            a0, b0, d0, e0 = _four(v, rows[r] + u)
            a1, b1, d1, e1 = _four(v, rows[r + 1] + u)
            a2, b2, d2, e2 = _four(v, rows[r + 2] + u)
            a3, b3, d3, e3 = _four(v, rows[r + 3] + u)
            block = ((a0, a1, a2, a3), (b0, b1, b2, b3), (d0, d1, d2, d3), (e0, e1, e2, e3))
            _multiply(block, weights, np.uintp(r * _TILE), mixed, np.uintp(c * _TILE), np.uintp(wide), r == 0)


@njit(cache=True, nogil=True)
def _four(x: F32x1, at: np.uintp) -> _Four:  # pragma: no cover
    return x[at], x[at + _ONE], x[at + _TWO], x[at + _THREE]  # pyright: ignore[reportReturnType]


@njit(cache=True, nogil=True, fastmath=FAST)
def _multiply(
    block: _Block, x: F32x1, s: np.uintp, out: F32x1, o: np.uintp, wide: np.uintp, is_first: bool
) -> None:  # pragma: no cover
    """Four rows of out from o on (+)= block (4, 4) times four rows of x from s on; rows are _TILE apart."""
    (a0, a1, a2, a3), (b0, b1, b2, b3), (d0, d1, d2, d3), (e0, e1, e2, e3) = block
    if is_first:
        for i in range(wide):
            w, y, z, t = x[s + i], x[s + _ROW + i], x[s + _TWO_ROWS + i], x[s + _THREE_ROWS + i]
            out[o + i] = a0 * w + a1 * y + a2 * z + a3 * t
            out[o + _ROW + i] = b0 * w + b1 * y + b2 * z + b3 * t
            out[o + _TWO_ROWS + i] = d0 * w + d1 * y + d2 * z + d3 * t
            out[o + _THREE_ROWS + i] = e0 * w + e1 * y + e2 * z + e3 * t
    else:
        for i in range(wide):
            w, y, z, t = x[s + i], x[s + _ROW + i], x[s + _TWO_ROWS + i], x[s + _THREE_ROWS + i]
            out[o + i] += a0 * w + a1 * y + a2 * z + a3 * t
            out[o + _ROW + i] += b0 * w + b1 * y + b2 * z + b3 * t
            out[o + _TWO_ROWS + i] += d0 * w + d1 * y + d2 * z + d3 * t
            out[o + _THREE_ROWS + i] += e0 * w + e1 * y + e2 * z + e3 * t


@njit(cache=True, nogil=True, fastmath=FAST)
def _exponentials(x: F32x1, rows: int, wide: int, sums: F32x1) -> None:  # pragma: no cover
    """x (rows, wide) becomes 2^(x - its column's largest); sums: those largest, then the sums of the columns."""
    end = np.uintp(wide)
    for i in range(end):
        sums[i], sums[_ROW + i] = x[i], np.float32(0.0)
    for j in range(0, rows, 4):
        o = np.uintp(j * _TILE)
        for i in range(end):
            a, b, d, e = x[o + i], x[o + _ROW + i], x[o + _TWO_ROWS + i], x[o + _THREE_ROWS + i]
            sums[i] = max(sums[i], max(max(a, b), max(d, e)))
    for j in range(0, rows, 4):
        o = np.uintp(j * _TILE)
        for i in range(end):
            top = sums[i]
            a, b = power_of_two(x[o + i] - top), power_of_two(x[o + _ROW + i] - top)
            d, e = power_of_two(x[o + _TWO_ROWS + i] - top), power_of_two(x[o + _THREE_ROWS + i] - top)
            x[o + i], x[o + _ROW + i], x[o + _TWO_ROWS + i], x[o + _THREE_ROWS + i] = a, b, d, e
            sums[_ROW + i] += (a + b) + (d + e)


@njit(cache=True, nogil=True, fastmath=FAST)
def _attend_backward(
    given: _Given, gradients: _Gradients, heads: int, width: int, order: I64x1, start: I64x1
) -> None:  # pragma: no cover
    """Write the gradients, which are zeros at first. Window by window and head by head, in tiles of queries and of keys."""
    (q, k, v, grad), (dq, dk, dv) = given, gradients
    max_keys = 4
    for w in range(start.shape[0] - 1):
        max_keys = max(max_keys, (start[w + 1] - start[w] + 3) // 4 * 4)
    rows, sums = np.empty(max_keys, np.uintp), np.empty(2 * _TILE, np.float32)
    # With a column for each query.
    queries, outer = np.empty(width * _TILE, np.float32), np.empty(width * _TILE, np.float32)
    weights, slopes = np.empty(max_keys * _TILE, np.float32), np.empty(max_keys * _TILE, np.float32)
    # With a column for each key: a tile turned round, and what is mixed by it.
    turned, mixed = np.empty(_TILE * _TILE, np.float32), np.empty(width * _TILE, np.float32)
    scale, one = np.float32(1 / math.sqrt(width)), np.float32(1)
    for w in range(start.shape[0] - 1):
        n = start[w + 1] - start[w]
        padded = (n + 3) // 4 * 4
        for j in range(padded):
            rows[j] = np.uintp(order[start[w] + min(j, n - 1)] * heads * width)
        for _ in range(heads):
            for at in range(0, n, _TILE):
                count = min(n - at, _TILE)
                wide = (count + _VECTOR - 1) // _VECTOR * _VECTOR
                some = rows[at : at + (count + 3) // 4 * 4]
                _gather(q, some, width, wide, scale * np.float32(math.log2(math.e)), queries)
                _gather(grad, some, width, wide, one, outer)
                _scores(k, rows, queries, weights, padded, width, wide)
                weights[n * _TILE : padded * _TILE] = np.float32(-1e30)
                _exponentials(weights, padded, wide, sums)
                _scores(v, rows, outer, slopes, padded, width, wide)
                _softmax_slopes(weights, slopes, sums, n, padded, wide)
                _mix(k, rows, slopes, mixed, padded, width, wide)
                _add(mixed, some[:count], width, scale, dq)
                for first in range(0, n, _TILE):
                    keys = min(n - first, _TILE)
                    broad = (keys + _VECTOR - 1) // _VECTOR * _VECTOR
                    others = rows[first : first + keys]
                    _turn(weights, first, keys, count, turned)
                    _mix(grad, some, turned, mixed, some.shape[0], width, broad)
                    _add(mixed, others, width, one, dv)
                    _turn(slopes, first, keys, count, turned)
                    _mix(q, some, turned, mixed, some.shape[0], width, broad)
                    _add(mixed, others, width, scale, dk)
            for j in range(padded):
                rows[j] += np.uintp(width)


@njit(cache=True, nogil=True, fastmath=FAST)
def _softmax_slopes(
    weights: F32x1, slopes: F32x1, sums: F32x1, n: int, padded: int, wide: int
) -> None:  # pragma: no cover
    """weights become probabilities over n keys, slopes (gradients of probabilities) gradients of scores; both 0 beyond."""
    end = np.uintp(wide)
    for i in range(end):
        sums[i], sums[_ROW + i] = np.float32(0), np.float32(1) / sums[_ROW + i]
    for j in range(n):
        o = np.uintp(j * _TILE)
        for i in range(end):
            weights[o + i] *= sums[_ROW + i]
            sums[i] += weights[o + i] * slopes[o + i]
    for j in range(n):
        o = np.uintp(j * _TILE)
        for i in range(end):
            slopes[o + i] = weights[o + i] * (slopes[o + i] - sums[i])
    weights[n * _TILE : padded * _TILE] = np.float32(0)
    slopes[n * _TILE : padded * _TILE] = np.float32(0)


@njit(cache=True, nogil=True)
def _turn(x: F32x1, first: int, keys: int, count: int, turned: F32x1) -> None:  # pragma: no cover
    """turned[i, j] = x[first + j, i] of so many keys j and queries i; 0 for other j and i up to a multiple of four."""
    turned[: (count + 3) // 4 * 4 * _TILE] = np.float32(0)
    for j in range(np.uintp(keys)):
        o = np.uintp((first + j) * _TILE)
        for i in range(np.uintp(count)):
            turned[i * _ROW + j] = x[o + i]


@njit(cache=True, nogil=True, fastmath=FAST)
def _add(columns: F32x1, rows: Uintpx1, width: int, scale: np.float32, out: F32x1) -> None:  # pragma: no cover
    """out[rows[i] + c] += columns[c, i] * scale."""
    for i in range(rows.shape[0]):
        at, to = np.uintp(i), rows[i]
        for c in range(np.uintp(width)):
            out[to + c] += columns[at + c * _ROW] * scale
