# SPDX-License-Identifier: Apache-2.0
"""Self-attention over the tokens of all agents in windows of the ego's frame: DAST in place of FAST (CoSTr Table
III).
"""

from __future__ import annotations

from torch import nn

from manyeyes.models.detector.transformer import AttentionConfig, WindowTransformer
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens


@register_fusion("self-attention")
class SelfAttentionFusion(nn.Module):
    """Window self-attention over all agents' tokens, then TokenMerge with softmax weights."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.encoding, self.transformer = SpatioTemporalEncoding(channels), WindowTransformer(channels, config)
        self.merge = TokenMerge(channels, "softmax")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        placed = self.encoding(tokens.features, tokens, place)
        attended = self.transformer(placed, tokens.xy, tokens.ego, tokens.grid)
        return self.merge(attended, tokens, key, place)
