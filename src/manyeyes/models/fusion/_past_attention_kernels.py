# SPDX-License-Identifier: Apache-2.0
"""Attention of tokens to past tokens of their window, with its feed-forward network, compiled: for inference on the CPU.

``flow_aware.PastAttention`` is the reference. Tokens of windows without a past token are left out of every product.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x1, F32x2, I64x1, njit, set_row
from manyeyes.ops._attention_block_kernels import (
    CHUNK,
    BlockMatrices,
    add_bias_rows,
    add_feed_forward,
    add_linear,
    normalize_rows,
    place_rows,
)
from manyeyes.ops._sparse_conv_kernels import empty_rows
from manyeyes.ops._window_order_kernels import order_windows
from manyeyes.ops._window_softmax_kernels import attend_across


class PastVectors(NamedTuple):
    """Biases of query, key, value and of the feed-forward net's two layers, then weights and biases of the three norms."""

    query: F32x1
    key: F32x1
    value: F32x1
    hidden: F32x1
    feed_forward: F32x1
    norm_weight: F32x1
    norm_bias: F32x1
    past_norm_weight: F32x1
    past_norm_bias: F32x1
    feed_forward_norm_weight: F32x1
    feed_forward_norm_bias: F32x1


class WindowTokens(NamedTuple):
    """Features (N, C) of tokens, their windows (N,) and their offsets (N, 2) in these, cells."""

    features: F32x2
    window: I64x1
    offsets: F32x2


@njit(cache=True, nogil=True)
def _select_shared(
    window: I64x1, order: I64x1, other: I64x1, other_order: I64x1
) -> tuple[I64x1, I64x1]:  # pragma: no cover
    """Return tokens of the windows (N,) that other (M,) has too, window by window, and where each window begins.

    order, other_order: both sorted.
    """
    chosen, start = np.empty(order.shape[0], np.int64), np.zeros(order.shape[0] + 1, np.int64)
    count, windows, b = 0, 0, 0
    for a in range(order.shape[0]):
        here = window[order[a]]
        while b < other_order.shape[0] and other[other_order[b]] < here:
            b += 1
        if b < other_order.shape[0] and other[other_order[b]] == here:
            if count == 0 or window[chosen[count - 1]] != here:
                windows += 1
            chosen[count] = order[a]
            count += 1
            start[windows] = count
    return chosen[:count], start[: windows + 1]


@njit(cache=True, nogil=True)
def _gather(features: F32x2, offsets: F32x2, rows: I64x1) -> tuple[F32x2, F32x2]:  # pragma: no cover
    """Return features (K, C) and offsets (K, 2) of rows (K,)."""
    some, places = empty_rows(rows.shape[0], features.shape[1]), np.empty((rows.shape[0], 2), np.float32)
    for i in range(rows.shape[0]):
        set_row(some[i], features[rows[i]])
        set_row(places[i], offsets[rows[i]])
    return some, places


@njit(cache=True, nogil=True)
def attend_past(
    tokens: WindowTokens,
    past: WindowTokens,
    frequency: F32x1,
    heads: int,
    matrices: BlockMatrices,
    vectors: PastVectors,
) -> F32x2:  # pragma: no cover
    """Return features (N, C) of the tokens, changed where their window holds past tokens."""
    out = tokens.features.copy()
    order, past_order = order_windows(tokens.window), order_windows(past.window)
    chosen, start = _select_shared(tokens.window, order, past.window, past_order)
    known, past_start = _select_shared(past.window, past_order, tokens.window, order)
    n, m, channels = chosen.shape[0], known.shape[0], out.shape[1]
    if n == 0:
        return out
    rows, past_rows = np.arange(n), np.arange(m)
    x, offsets = _gather(tokens.features, tokens.offsets, chosen)
    y, past_offsets = _gather(past.features, past.offsets, known)
    normed, placed = empty_rows(max(m, min(n, CHUNK)), channels), empty_rows(max(m, min(n, CHUNK)), channels)
    q, k, v = add_bias_rows(n, vectors.query), add_bias_rows(m, vectors.key), add_bias_rows(m, vectors.value)
    normalize_rows(y, vectors.past_norm_weight, vectors.past_norm_bias, normed[:m])
    place_rows(normed[:m], past_offsets, frequency, placed[:m])
    add_linear(placed[:m], matrices.key, k)
    add_linear(normed[:m], matrices.value, v)
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        there, here = normed[: b - a], placed[: b - a]
        normalize_rows(x[a:b], vectors.norm_weight, vectors.norm_bias, there)
        place_rows(there, offsets[a:b], frequency, here)
        add_linear(here, matrices.query, q[a:b])
    flat_q, flat_k, flat_v = q.reshape(-1), k.reshape(-1), v.reshape(-1)
    # A head's queries of a tile are read before its results are written.
    attend_across(flat_q, flat_k, flat_v, flat_q, heads, channels // heads, rows, start, past_rows, past_start)
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        there, some = normed[: b - a], x[a:b]
        add_linear(q[a:b], matrices.output, some)
        normalize_rows(some, vectors.feed_forward_norm_weight, vectors.feed_forward_norm_bias, there)
        add_feed_forward(there, matrices, vectors.hidden, vectors.feed_forward, some)
    for i in range(n):
        set_row(out[chosen[i]], x[i])
    return out
