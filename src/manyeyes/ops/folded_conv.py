# SPDX-License-Identifier: Apache-2.0
"""Convolutions on occupied cells with bias and ReLU, one after another on one set of sites, in one compiled call.

For inference on the CPU, where norms and skips are folded into the weights: a few hundred rows are little work for each of
the tensor operations of a layer. ``models.detector.layers`` holds the twin with gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes._jit import F32x1, F32x2, F32x4, F32x5, njit, set_row
from manyeyes.ops._sparse_conv_kernels import HAS_BFLOAT16, LANES, add_products, convolve, empty_rows, panels
from manyeyes.ops.sparse_index import NeighbourMap, Pairs


@dataclass(frozen=True, eq=False)
class FoldedConvs:
    """Layers of equal shape. weight: (layers, taps, D / width, C, width), the ``panels`` of each; bias: (layers, D)."""

    weight: Tensor
    bias: Tensor

    @classmethod
    def of(
        cls, weights: Sequence[Tensor], biases: Sequence[Tensor], *, in_bfloat16: bool = False
    ) -> FoldedConvs | None:
        """Return copies of weights (D, C, k, k) and biases (D,); None where the loops do not know such.

        in_bfloat16: products of bfloat16 with float32 sums, where the processor has them.
        """
        if not weights or any(w.shape[0] % LANES or w.dtype != torch.float32 or w.is_cuda for w in weights):
            return None
        taps = (w.detach().permute(2, 3, 1, 0).reshape(-1, w.shape[1], w.shape[0]) for w in weights)
        in_bfloat16 = in_bfloat16 and HAS_BFLOAT16
        return cls(
            torch.stack([torch.from_numpy(panels(t, in_bfloat16)) for t in taps]),
            torch.stack([b.detach() for b in biases]),
        )

    @torch.no_grad()
    def __call__(self, x: Tensor, table: NeighbourMap) -> Tensor:
        """Apply all layers, (N, C) to (M, D); more than one need a table that leads from a set of sites to itself."""
        rows, weight, bias = (t.numpy() for t in (x.contiguous(), self.weight, self.bias))
        return torch.from_numpy(apply_layers(rows, weight, bias, table.pairs, table.is_symmetric, table.n_out))


@dataclass(frozen=True, eq=False)
class FoldedUp:
    """An inverse convolution added to a lateral layer, with bias and ReLU.

    weight: (taps, D / width, C, width); lateral: (1, D / width, L, width), the ``panels`` of both; bias: (D,).
    """

    weight: Tensor
    lateral: Tensor
    bias: Tensor

    @classmethod
    def of(cls, weight: Tensor, lateral: Tensor, bias: Tensor, in_bfloat16: bool = False) -> FoldedUp | None:
        """Return copies of weight (D, C, k, k), lateral (D, L) and bias (D,); None where the loops do not know such."""
        convs = FoldedConvs.of([weight], [bias], in_bfloat16=in_bfloat16)
        if convs is None:
            return None
        matrix = panels(lateral.detach().T[None], in_bfloat16 and HAS_BFLOAT16)
        return cls(convs.weight[0], torch.from_numpy(matrix), convs.bias[0])

    @torch.no_grad()
    def __call__(self, coarse: Tensor, fine: Tensor, table: NeighbourMap) -> Tensor:
        """Return (N, D) on the finer sites; table: from the finer sites (N,) to the coarser, whose pairs are turned round."""
        rows, beside = coarse.contiguous().numpy(), fine.contiguous().numpy()
        weight, lateral, bias = (t.numpy() for t in (self.weight, self.lateral, self.bias))
        turned = Pairs(table.pairs.target, table.pairs.source, table.pairs.counts)
        return torch.from_numpy(convolve_up(rows, weight, beside, lateral, bias, turned))


class _RowNorm(NamedTuple):
    """The norm of a :class:`NormedConv` for the loops: scale, shift (D,), eps beside the variance, and whether x is added."""

    scale: F32x1
    shift: F32x1
    eps: float
    is_skipped: bool


@dataclass(frozen=True, eq=False)
class NormedConv:
    """A convolution, the layer norm of each row, x itself where is_skipped, and ReLU. weight: (taps, D / width, C, width), its
    ``panels``; scale, shift: (D,), of the norm; eps: beside its variance.
    """

    weight: Tensor
    scale: Tensor
    shift: Tensor
    eps: float
    is_skipped: bool

    @classmethod
    def of(cls, weight: Tensor, norm: nn.LayerNorm, is_skipped: bool) -> NormedConv | None:
        """Return copies of a weight (D, C, k, k) and a norm; None where the loops do not know such."""
        one = FoldedConvs.of([weight], [norm.bias])
        return one and cls(one.weight[0], norm.weight.detach().clone(), one.bias[0], norm.eps, is_skipped)

    @torch.no_grad()
    def __call__(self, x: Tensor, table: NeighbourMap) -> Tensor:
        """Apply the layer, (N, C) to (M, D)."""
        rows, weight, scale, shift = (t.numpy() for t in (x.contiguous(), self.weight, self.scale, self.shift))
        norm = _RowNorm(scale, shift, self.eps, self.is_skipped)
        return torch.from_numpy(
            _convolve_and_normalize(rows, weight, norm, table.pairs, table.is_symmetric, table.n_out)
        )


def is_supported(x: Tensor) -> bool:
    """Return whether the loops may take it: no gradient is asked for, and it is float32 in the CPU's memory."""
    return not torch.is_grad_enabled() and x.device.type == "cpu" and x.dtype == torch.float32


@njit(cache=True, nogil=True)
def apply_layers(
    x: F32x2, weight: F32x5, bias: F32x2, pairs: Pairs, is_symmetric: bool, rows: int
) -> F32x2:  # pragma: no cover
    """Return all layers of x (N, C), one after another: (rows, D); weight and bias as of ``FoldedConvs``."""
    out = empty_rows(rows, bias.shape[1])
    convolve(x, weight[0], bias[0], pairs, is_symmetric, True, out)
    spare = empty_rows(*out.shape)
    for layer in range(1, weight.shape[0]):
        convolve(out, weight[layer], bias[layer], pairs, is_symmetric, True, spare)
        out, spare = spare, out
    return out


@njit(cache=True, nogil=True)
def convolve_up(
    x: F32x2, weight: F32x4, fine: F32x2, lateral: F32x4, bias: F32x1, pairs: Pairs
) -> F32x2:  # pragma: no cover
    """Return (N, D) on the rows of fine (N, L), from x (M, C); weights as of ``FoldedUp``."""
    n = fine.shape[0]
    out, rows = empty_rows(n, bias.shape[0]), np.arange(n)
    for i in range(n):
        set_row(out[i], bias)
    add_products(fine, lateral, 0, 1, rows, rows, np.full(1, n), out)
    add_products(x, weight, 0, 1, pairs.source, pairs.target, pairs.counts, out)
    flat = out.reshape(-1)
    for i in range(np.uintp(flat.shape[0])):
        flat[i] = max(flat[i], np.float32(0))
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "nnan", "reassoc"})
def _convolve_and_normalize(
    x: F32x2, weight: F32x4, norm: _RowNorm, pairs: Pairs, is_symmetric: bool, rows: int
) -> F32x2:  # pragma: no cover
    scale, shift, eps, is_skipped = norm
    out, channels = empty_rows(rows, scale.shape[0]), scale.shape[0]
    convolve(x, weight, np.zeros_like(shift), pairs, is_symmetric, False, out)
    for i in range(rows):
        mean, square = np.float32(0), np.float32(0)
        for c in range(channels):
            mean += out[i, c]
        mean /= np.float32(channels)
        for c in range(channels):
            square += (out[i, c] - mean) * (out[i, c] - mean)
        steep = np.float32(1) / np.sqrt(square / np.float32(channels) + np.float32(eps))
        if is_skipped:
            for c in range(channels):
                out[i, c] = max((out[i, c] - mean) * steep * scale[c] + shift[c] + x[i, c], np.float32(0))
        else:
            for c in range(channels):
                out[i, c] = max((out[i, c] - mean) * steep * scale[c] + shift[c], np.float32(0))
    return out
