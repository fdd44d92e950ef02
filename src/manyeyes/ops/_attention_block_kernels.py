# SPDX-License-Identifier: Apache-2.0
"""A whole block of window attention (CoSTr Eq. 4, 6, 7) in one compiled call: for inference on the CPU.

A few hundred tokens are little work for each of the thirty tensor operations of a block; here products run at the rate of
``_sparse_conv_kernels``, and norms, encodings and activations are loops that a compiler turns into vectors.
``models.detector.transformer`` is the twin with gradients.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes._jit import F32x1, F32x2, F32x4, I64x1, njit, set_row
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16, LANES, add_products, empty_rows, panels
from manyeyes.ops._window_attention_kernels import WindowRuns
from manyeyes.ops._window_softmax_kernels import FAST, attend, power_of_two

CHUNK = 720
"""Rows at once through the layers of a block, so that what lies between two layers stays in the second cache."""
_EPS = 1e-5
# Sine and cosine on [-pi/4, pi/4], error below 1e-7 (Taylor), and pi/2 in two parts, so that nothing is lost on taking it off.
_SINE = tuple(map(np.float32, (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880)))
_COSINE = tuple(map(np.float32, (-1 / 2, 1 / 24, -1 / 720, 1 / 40320)))
_HALF_PI, _HALF_PI_REST = np.float32(1.5703125), np.float32(math.pi / 2 - 1.5703125)
# erf within 1.5e-7 (Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26).
_ERF = tuple(map(np.float32, (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)))
_ERF_T, _SQUARE = np.float32(0.3275911 / math.sqrt(2)), np.float32(-math.log2(math.e) / 2)


class BlockMatrices(NamedTuple):
    """Weights (inputs, outputs) float32 of the linear layers, each in panels (1, outputs / width, inputs, width)."""

    query: F32x4
    key: F32x4
    value: F32x4
    output: F32x4
    hidden: F32x4
    feed_forward: F32x4


class BlockVectors(NamedTuple):
    """Biases of the six linear layers, then weights and biases of the two norms: (outputs,) and (C,) float32."""

    query: F32x1
    key: F32x1
    value: F32x1
    output: F32x1
    hidden: F32x1
    feed_forward: F32x1
    attention_norm_weight: F32x1
    attention_norm_bias: F32x1
    feed_forward_norm_weight: F32x1
    feed_forward_norm_bias: F32x1


@dataclass(frozen=True, eq=False)
class BlockWeights:
    """Weights and biases of query, key, value, output and the feed-forward net's two layers, and of the two norms.

    frequency: (C / 4,) of the encoding of offsets.
    """

    matrices: BlockMatrices
    vectors: BlockVectors
    heads: int
    frequency: F32x1

    @classmethod
    def of(
        cls, linears: list[nn.Linear], norms: list[nn.LayerNorm], heads: int, in_bfloat16: bool = False
    ) -> BlockWeights | None:
        """Return copies of the weights of six layers and two norms; None where the loops do not know such.

        in_bfloat16: linear layers by products of bfloat16 with float32 sums, where the processor has them.
        """
        if any(n.eps != _EPS for n in norms) or any(w.out_features % LANES or w.weight.is_cuda for w in linears):
            return None
        tensors = [
            *(w.weight.new_zeros(w.out_features) if w.bias is None else w.bias for w in linears),
            *(t for n in norms for t in (n.weight, n.bias)),
        ]
        matrices = BlockMatrices(
            *(panels(w.weight.detach().float().T[None], in_bfloat16 and HAS_BFLOAT16) for w in linears)
        )
        channels = linears[0].in_features
        frequency = (10000.0 ** (-4.0 * np.arange(channels // 4) / channels)).astype(np.float32)
        vectors = BlockVectors(*(t.detach().float().contiguous().numpy() for t in tensors))
        return cls(matrices, vectors, heads, frequency)


@torch.no_grad()
def run_block(features: Tensor, offsets: Tensor, runs: WindowRuns, weights: BlockWeights) -> Tensor:
    """features (N, C) float32 of tokens at offsets (N, 2) cells in their windows to (N, C)."""
    x, u = features.contiguous().numpy(), offsets.contiguous().numpy()
    order, start = runs.order.numpy(), runs.start.numpy()
    matrices, vectors = weights.matrices, weights.vectors
    return torch.from_numpy(_block(x, u, weights.frequency, order, start, weights.heads, matrices, vectors))


@njit(cache=True, nogil=True)
def _block(
    x: F32x2,
    offsets: F32x2,
    frequency: F32x1,
    order: I64x1,
    start: I64x1,
    heads: int,
    matrices: BlockMatrices,
    vectors: BlockVectors,
) -> F32x2:  # pragma: no cover
    n, channels = x.shape
    normed, placed = empty_rows(min(n, CHUNK), channels), empty_rows(min(n, CHUNK), channels)
    q, k, v = add_bias_rows(n, vectors.query), add_bias_rows(n, vectors.key), add_bias_rows(n, vectors.value)
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        there, here = normed[: b - a], placed[: b - a]
        normalize_rows(x[a:b], vectors.attention_norm_weight, vectors.attention_norm_bias, there)
        place_rows(there, offsets[a:b], frequency, here)
        add_linear(here, matrices.query, q[a:b])
        add_linear(here, matrices.key, k[a:b])
        add_linear(there, matrices.value, v[a:b])
    # A head's queries of a tile are read before its results are written.
    attend(q.reshape(-1), k.reshape(-1), v.reshape(-1), q.reshape(-1), heads, channels // heads, order, start)
    out = empty_rows(n, channels)
    for i in range(n):
        for c in range(channels):
            out[i, c] = x[i, c] + vectors.output[c]
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        there, some = normed[: b - a], out[a:b]
        add_linear(q[a:b], matrices.output, some)
        normalize_rows(some, vectors.feed_forward_norm_weight, vectors.feed_forward_norm_bias, there)
        add_feed_forward(there, matrices, vectors.hidden, vectors.feed_forward, some)
    return out


@njit(cache=True, nogil=True)
def add_linear(x: F32x2, weight: F32x4, out: F32x2) -> None:  # pragma: no cover
    """out (N, D) += x (N, C) times the ``panels`` of a matrix."""
    rows = np.arange(x.shape[0])
    add_products(x, weight, 0, 1, rows, rows, np.full(1, x.shape[0]), out)


@njit(cache=True, nogil=True)
def add_feed_forward(
    x: F32x2, matrices: BlockMatrices, hidden_bias: F32x1, bias: F32x1, out: F32x2
) -> None:  # pragma: no cover
    """out (N, C) += the feed-forward network of x (N, C)."""
    hidden = add_bias_rows(x.shape[0], hidden_bias)
    add_linear(x, matrices.hidden, hidden)
    apply_gelu(hidden.reshape(-1))
    out += bias
    add_linear(hidden, matrices.feed_forward, out)


@njit(cache=True, nogil=True)
def add_bias_rows(n: int, bias: F32x1) -> F32x2:  # pragma: no cover
    """Return (n, outputs): what the products are added to."""
    out = empty_rows(n, bias.shape[0])
    for i in range(n):
        set_row(out[i], bias)
    return out


@njit(cache=True, nogil=True, fastmath=FAST)
def normalize_rows(x: F32x2, weight: F32x1, bias: F32x1, out: F32x2) -> None:  # pragma: no cover
    """Layer norm of rows (N, C)."""
    n, channels = x.shape
    for i in range(n):
        mean, square = np.float32(0), np.float32(0)
        for c in range(channels):
            mean += x[i, c]
        mean /= np.float32(channels)
        for c in range(channels):
            square += (x[i, c] - mean) * (x[i, c] - mean)
        scale = np.float32(1) / np.sqrt(square / np.float32(channels) + np.float32(_EPS))
        for c in range(channels):
            out[i, c] = (x[i, c] - mean) * scale * weight[c] + bias[c]


@njit(cache=True, nogil=True, fastmath=FAST)
def place_rows(x: F32x2, offsets: F32x2, frequency: F32x1, out: F32x2) -> None:  # pragma: no cover
    """out = x plus ``sincos_encoding`` of offsets (N, 2)."""
    quarter = frequency.shape[0]
    for i in range(x.shape[0]):
        for axis in range(2):
            u, row, to = offsets[i, axis], x[i, 2 * quarter * axis :], out[i, 2 * quarter * axis :]
            for j in range(quarter):
                angle = u * frequency[j]
                turns = np.rint(angle * np.float32(2 / math.pi))
                r = (angle - turns * _HALF_PI) - turns * _HALF_PI_REST
                s = r * r
                sine = r + r * s * (_SINE[0] + s * (_SINE[1] + s * (_SINE[2] + s * _SINE[3])))
                cosine = np.float32(1) + s * (_COSINE[0] + s * (_COSINE[1] + s * (_COSINE[2] + s * _COSINE[3])))
                quadrant = np.int32(turns) & 3
                a, b = (cosine, sine) if quadrant & 1 else (sine, cosine)
                to[2 * j] = row[2 * j] + (-a if quadrant & 2 else a)
                to[2 * j + 1] = row[2 * j + 1] + (-b if quadrant == 1 or quadrant == 2 else b)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def apply_gelu(x: F32x1) -> None:  # pragma: no cover
    """x (N,) becomes x / 2 (1 + erf(x / sqrt(2)))."""
    for i in range(np.uintp(x.shape[0])):
        t = np.float32(1) / (np.float32(1) + _ERF_T * abs(x[i]))
        tail = t * (_ERF[4] + t * (_ERF[3] + t * (_ERF[2] + t * (_ERF[1] + t * _ERF[0]))))
        tail *= np.float32(0.5) * power_of_two(x[i] * x[i] * _SQUARE)
        x[i] *= np.float32(1) - tail if x[i] > 0 else tail
