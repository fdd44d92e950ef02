# SPDX-License-Identifier: Apache-2.0
"""Layers that several fusion rules use."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.layers import conv_weight
from manyeyes.ops.sparse_conv import submanifold_conv


class PlainConv(nn.Module):
    """3x3 convolution with bias on the same sites, without norm or ReLU."""

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__()
        self.weight = conv_weight(outputs, inputs, 3)
        self.bias = nn.Parameter(torch.zeros(outputs, device="cpu")) if bias else None

    def forward(self, x: SparseBev) -> Tensor:
        """Map (N, inputs) to (N, outputs)."""
        return submanifold_conv(x, self.weight, self.bias).features
