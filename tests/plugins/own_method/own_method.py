# SPDX-License-Identifier: Apache-2.0
"""A fusion module, and a strategy that sends the tokens of moving objects first."""

import torch
from torch import Tensor, nn

from manyeyes import AgentFrame, FusionStrategy, register_fusion, register_strategy
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_velocity
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.voxelize import segment_mean


@register_fusion("mean")
class MeanFusion(nn.Module):
    """Mean of the features of all agents in a cell; boxes are merged as in the other fusion modules."""

    def __init__(self, channels: int, attention: AttentionConfig) -> None:
        super().__init__()
        self.merge = TokenMerge(channels, "max")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, cell_offset = assign_cells(tokens)
        merged = self.merge(tokens.features, tokens, key, cell_offset)
        row = torch.searchsorted(merged.bev.sites.key, key)
        mean = segment_mean(tokens.features, row, len(merged.bev.sites))
        return FusedBev(merged.bev.with_features(mean), merged.merged_proposals)


def score_moving(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Score (N,) of tokens: the confidence of an object, times its speed; a budget keeps the highest."""
    proposals = cache.process_tokens(frame).shared_tokens.features[:, -PROPOSAL_DIM:]
    return torch.sigmoid(proposed_heat(proposals)) * (1 + proposed_velocity(proposals).norm(dim=1))


@register_strategy("moving-first")
def moving_first() -> FusionStrategy:
    """Intermediate fusion with another selection."""
    return IntermediateFusion(score=score_moving)
