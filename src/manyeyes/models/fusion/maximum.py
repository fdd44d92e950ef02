# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on tokens moved metrically."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.models.fusion.gather import CUES, Tokens
from manyeyes.models.fusion.settle import WORD_SCALE, Fused, Settle, settle
from manyeyes.models.proposal import PROPOSAL


class Placement(nn.Module):
    """Tells a feature where it landed: its place in its cell, height and turn of its sender, and what the sender proposed.

    Ends in zeros, so that fusion starts as if without.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Linear(CUES + 2 + PROPOSAL, 2 * channels)
        self.outer = nn.Linear(2 * channels, channels, bias=False)
        nn.init.zeros_(self.outer.weight)

    def forward(self, features: Tensor, tokens: Tokens, place: Tensor) -> Tensor:
        """(N, C) to (N, C); place (N, 2) from the cell's centre, in cells."""
        words = torch.cat((tokens.cue, place, tokens.proposal * WORD_SCALE), 1)
        return features + self.outer(torch.relu(self.inner(words)))


class MaximumFusion(nn.Module):
    """Every agent's feature on the cell where it settles; the maximum of each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.placement, self.settle = Placement(channels), Settle(channels, "max")

    def forward(self, tokens: Tokens) -> Fused:
        """Tokens of all agents to one feature and one box a cell."""
        key, place = settle(tokens)
        return self.settle(self.placement(tokens.features, tokens, place), tokens, key, place)
