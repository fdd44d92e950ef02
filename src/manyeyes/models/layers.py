# SPDX-License-Identifier: Apache-2.0
"""Layers on occupied cells: normalisation that survives empty input, and convolutions that keep their weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from manyeyes.datatypes import Sites, SparseBev
from manyeyes.ops.sparse_conv import inverse_conv, strided_conv, submanifold_conv


class ActiveNorm(nn.BatchNorm1d):
    """Batch normalisation over active rows (N, C); with fewer than two rows it uses its running statistics."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=1e-3, momentum=0.02)

    def forward(self, input: Tensor) -> Tensor:
        """(N, C) to (N, C)."""
        if self.training and input.shape[0] < 2:
            return nn.functional.batch_norm(
                input, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
            )
        return super().forward(input)


def conv_weight(a: int, b: int, kernel: int) -> nn.Parameter:
    """A (a, b, kernel, kernel) kernel with He initialisation over its b * kernel^2 inputs."""
    return nn.Parameter(torch.randn(a, b, kernel, kernel) * math.sqrt(2.0 / (b * kernel * kernel)))


class SubmanifoldLayer(nn.Module):
    """Submanifold convolution, norm, optional skip, ReLU: the sites stay as they are."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3) -> None:
        super().__init__()
        self.weight, self.norm = conv_weight(outputs, inputs, kernel), ActiveNorm(outputs)
        self.skip = inputs == outputs

    def forward(self, x: SparseBev) -> SparseBev:
        """(N, inputs) to (N, outputs) on the same sites."""
        y = self.norm(submanifold_conv(x, self.weight).features)
        return x.with_features(torch.relu(y + x.features if self.skip else y))


class DownLayer(nn.Module):
    """3x3 convolution of stride 2, norm, ReLU; ``dilating`` chooses spconv's active set, else parents of active cells."""

    def __init__(self, inputs: int, outputs: int, dilating: bool) -> None:
        super().__init__()
        self.weight, self.norm, self.dilating = conv_weight(outputs, inputs, 3), ActiveNorm(outputs), dilating

    def forward(self, x: SparseBev) -> SparseBev:
        """Features at twice the stride."""
        y = strided_conv(x, self.weight, stride=2, padding=1, dilating=self.dilating)
        return y.with_features(torch.relu(self.norm(y.features)))


class UpLayer(nn.Module):
    """Inverse convolution back to a finer set of sites, norm, added to a projection of what was there, ReLU."""

    def __init__(self, inputs: int, lateral: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(inputs, outputs, 3, 3) * math.sqrt(2.0 / (inputs * 9 / 4)))
        self.norm, self.lateral = ActiveNorm(outputs), nn.Linear(lateral, outputs, bias=False)

    def forward(self, coarse: SparseBev, fine: SparseBev) -> SparseBev:
        """Coarse features on the sites of ``fine``."""
        sites: Sites = fine.sites
        y = inverse_conv(coarse, self.weight, sites, stride=2, padding=1)
        return fine.with_features(torch.relu(self.norm(y.features + self.lateral(fine.features))))
