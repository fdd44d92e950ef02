# SPDX-License-Identifier: Apache-2.0
"""Self-attention over the tokens of all agents in windows of the ego's frame (CoSTr section III-D, without history)."""

from __future__ import annotations

from torch import nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.fusion.gather import Tokens, lattice_offset, to_lattice
from manyeyes.models.fusion.maximum import Placement
from manyeyes.models.transformer import AttentionConfig, WindowTransformer


class SelfAttentionFusion(nn.Module):
    """Tokens attend to each other where they are, then settle on the nearest cell; their mean where they meet."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.placement, self.transformer = Placement(channels), WindowTransformer(channels, config)

    def forward(self, tokens: Tokens) -> SparseBev:
        """Tokens of all agents to one feature a cell."""
        key, offset = lattice_offset(tokens)
        placed = self.placement(tokens.features, tokens, offset)
        cache = None if tokens.sites is None else tokens.sites.cache
        attended = self.transformer(placed, tokens.xy, tokens.ego, tokens.grid, cache)
        return to_lattice(attended, key, tokens, "mean")
