# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on metrically transformed tokens."""

from __future__ import annotations

from torch import nn

from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens


class MaxFusion(nn.Module):
    """Channel-wise maximum over the tokens assigned to each cell."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "max")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        return self.merge(self.encoding(tokens.features, tokens, place), tokens, key, place)
