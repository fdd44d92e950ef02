# SPDX-License-Identifier: Apache-2.0
"""Self-attention over the tokens of all agents in windows of the ego's frame: DAST in FAST's place (CoSTr Table III)."""

from __future__ import annotations

from torch import nn

from manyeyes.models.detector.transformer import AttentionConfig, WindowTransformer
from manyeyes.models.fusion.positional_encoding import Placement
from manyeyes.models.fusion.token_merge import Fused, Settle, settle
from manyeyes.models.fusion.transform_tokens import Tokens


class SelfAttentionFusion(nn.Module):
    """Tokens attend to each other where they are, then settle, and those that meet become one by trust."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.placement, self.transformer = Placement(channels), WindowTransformer(channels, config)
        self.settle = Settle(channels, "trust")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> Fused:
        """Tokens of all agents to one feature and one box a cell; the past is not looked at."""
        key, place = settle(tokens)
        placed = self.placement(tokens.features, tokens, place)
        attended = self.transformer(placed, tokens.xy, tokens.ego, tokens.grid)
        return self.settle(attended, tokens, key, place)
