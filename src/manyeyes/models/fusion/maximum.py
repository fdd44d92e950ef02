# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on tokens moved metrically."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.fusion.gather import CUES, Tokens, lattice_offset, to_lattice


class Placement(nn.Module):
    """Tells a feature how it was moved: offset to the cell it lands on, height and turn of its sender. Starts at zero."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.embed = nn.Linear(CUES + 2, channels, bias=False)
        nn.init.zeros_(self.embed.weight)

    def forward(self, features: Tensor, tokens: Tokens, offset: Tensor) -> Tensor:
        """(N, C) to (N, C)."""
        return features + self.embed(torch.cat((tokens.cue, offset), 1))


class MaximumFusion(nn.Module):
    """Every agent's feature on its nearest cell; the maximum of each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.placement = Placement(channels)

    def forward(self, tokens: Tokens) -> SparseBev:
        """Tokens of all agents to one feature a cell."""
        key, offset = lattice_offset(tokens)
        return to_lattice(self.placement(tokens.features, tokens, offset), key, tokens, "max")
