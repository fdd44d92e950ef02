# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on tokens moved metrically."""

from __future__ import annotations

from torch import nn

from manyeyes.models.fusion.positional_encoding import Placement
from manyeyes.models.fusion.token_merge import Fused, Settle, settle
from manyeyes.models.fusion.transform_tokens import Tokens


class MaximumFusion(nn.Module):
    """Every agent's feature on the cell where it settles; the maximum of each channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.placement, self.settle = Placement(channels), Settle(channels, "max")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> Fused:
        """Tokens of all agents to one feature and one box a cell; the past is not looked at."""
        key, place = settle(tokens)
        return self.settle(self.placement(tokens.features, tokens, place), tokens, key, place)
