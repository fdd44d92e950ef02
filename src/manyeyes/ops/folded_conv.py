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

from manyeyes._jit import F32x1, F32x2, F32x4, F32x5, njit
from manyeyes.ops._sparse_conv_kernels import LANES, convolve, empty_rows, panels
from manyeyes.ops.sparse_index import NeighbourMap, Pairs


@dataclass(frozen=True, eq=False)
class FoldedConvs:
    """Layers of equal shape. weight: (layers, taps, D / width, C, width), the ``panels`` of each; bias: (layers, D)."""

    weight: Tensor
    bias: Tensor

    @classmethod
    def of(cls, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> FoldedConvs | None:
        """Return copies of weights (D, C, k, k) and biases (D,); None where the loops do not know such."""
        if not weights or any(w.shape[0] % LANES or w.dtype != torch.float32 or w.is_cuda for w in weights):
            return None
        taps = (w.detach().permute(2, 3, 1, 0).reshape(-1, w.shape[1], w.shape[0]) for w in weights)
        return cls(torch.stack([torch.from_numpy(panels(t)) for t in taps]), torch.stack([b.detach() for b in biases]))

    @torch.no_grad()
    def __call__(self, x: Tensor, table: NeighbourMap) -> Tensor:
        """Apply all layers, (N, C) to (M, D); more than one need a table that leads from a set of sites to itself."""
        rows, weight, bias = (t.numpy() for t in (x.contiguous(), self.weight, self.bias))
        return torch.from_numpy(_layers(rows, weight, bias, table.pairs, table.is_symmetric, table.n_out))


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
def _layers(
    x: F32x2, weight: F32x5, bias: F32x2, pairs: Pairs, is_symmetric: bool, rows: int
) -> F32x2:  # pragma: no cover
    out = empty_rows(rows, bias.shape[1])
    convolve(x, weight[0], bias[0], pairs, is_symmetric, True, out)
    spare = empty_rows(*out.shape)
    for layer in range(1, weight.shape[0]):
        convolve(out, weight[layer], bias[layer], pairs, is_symmetric, True, spare)
        out, spare = spare, out
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
