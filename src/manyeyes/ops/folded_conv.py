# SPDX-License-Identifier: Apache-2.0
"""Convolutions on occupied cells with bias and ReLU, one after another on one set of sites, in one compiled call.

For inference on the CPU, where norms and skips are folded into the weights: a few hundred rows are little work for each of
the tensor operations of a layer. ``models.layers`` holds the twin with gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from numba import njit
from torch import Tensor

from manyeyes.ops.pair_loops import LANES, convolve, empty_rows, panels
from manyeyes.ops.sparse_index import NeighbourMap


@dataclass(frozen=True, eq=False)
class FoldedConvs:
    """Layers of equal shape. weight: (layers, taps, D / width, C, width), the ``panels`` of each; bias: (layers, D)."""

    weight: Tensor
    bias: Tensor

    @classmethod
    def of(cls, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> FoldedConvs | None:
        """Copies of weights (D, C, k, k) and biases (D,); None where the loops do not know such."""
        if not weights or any(w.shape[0] % LANES or w.dtype != torch.float32 or w.is_cuda for w in weights):
            return None
        taps = (w.permute(2, 3, 1, 0).reshape(-1, w.shape[1], w.shape[0]) for w in weights)
        return cls(torch.stack([torch.from_numpy(panels(t)) for t in taps]), torch.stack(list(biases)))

    def takes(self, x: Tensor) -> bool:
        """Whether the loops may take it: no gradient is asked for, and it is float32 in the CPU's memory."""
        return not torch.is_grad_enabled() and x.device.type == "cpu" and x.dtype == torch.float32

    @torch.no_grad()
    def __call__(self, x: Tensor, table: NeighbourMap) -> Tensor:
        """(N, C) to (M, D) through all layers; more than one need a table that leads from a set of sites to itself."""
        rows, weight, bias = (t.numpy() for t in (x.contiguous(), self.weight, self.bias))
        return torch.from_numpy(_layers(rows, weight, bias, *table.pairs, table.is_symmetric, table.n_out))


@njit(cache=True, nogil=True)
def _layers(x, weight, bias, source, target, counts, is_symmetric, rows):  # pragma: no cover
    out = empty_rows(rows, bias.shape[1])
    convolve(x, weight[0], bias[0], source, target, counts, is_symmetric, True, out)
    spare = empty_rows(*out.shape)
    for layer in range(1, weight.shape[0]):
        convolve(out, weight[layer], bias[layer], source, target, counts, is_symmetric, True, spare)
        out, spare = spare, out
    return out
