# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on tokens moved metrically."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.fusion.gather import CUES, Tokens, lattice_offset, to_lattice
from manyeyes.models.proposal import PROPOSAL


class Placement(nn.Module):
    """Tells a feature where it landed: offset to its cell, height and turn of its sender, and what the sender proposed there.

    The proposal's box is measured from the cell that the token lands on. Ends in zeros, so that fusion starts as if without.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Linear(CUES + 2 + PROPOSAL, 2 * channels)
        self.outer = nn.Linear(2 * channels, channels, bias=False)
        nn.init.zeros_(self.outer.weight)

    def forward(self, features: Tensor, tokens: Tokens, offset: Tensor) -> Tensor:
        """(N, C) to (N, C)."""
        proposed = (tokens.proposal != 0).any(1, keepdim=True)
        shift = torch.nn.functional.pad(offset * proposed, (1, PROPOSAL - 3))
        words = torch.cat((tokens.cue, offset, tokens.proposal + shift), 1)
        return features + self.outer(torch.relu(self.inner(words)))


class MaximumFusion(nn.Module):
    """Every agent's feature on its nearest cell; the maximum of each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.placement = Placement(channels)

    def forward(self, tokens: Tokens) -> SparseBev:
        """Tokens of all agents to one feature a cell."""
        key, offset = lattice_offset(tokens)
        return to_lattice(self.placement(tokens.features, tokens, offset), key, tokens, "max")
