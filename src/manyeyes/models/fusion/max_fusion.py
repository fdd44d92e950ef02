# SPDX-License-Identifier: Apache-2.0
"""Element-wise maximum over agents, cell by cell (F-Cooper, Chen et al. 2019), on metrically transformed tokens."""

from __future__ import annotations

from torch import Tensor, nn

from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_bare
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens


@register_fusion("max")
class MaxFusion(nn.Module):
    """Channel-wise maximum over the tokens assigned to each cell; it has no attention."""

    def __init__(self, channels: int, attention: AttentionConfig | None = None) -> None:
        super().__init__()
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "max")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        return self.merge(self.encoding(tokens.features, tokens, place), tokens, key, place)


@register_bare("max")
class MaxRule(nn.Module):
    """Channel-wise maximum over the senders of a cell; an absent sender is a row of zeros, or left out."""

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.absent: AbsentSenders = absent

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        return rows.max(self.absent)
