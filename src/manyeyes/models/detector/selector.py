# SPDX-License-Identifier: Apache-2.0
"""Token selection (CoSTr section III-E): one learned score per token; under a budget the highest are sent."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.models.fusion.token_merge import PROPOSAL_SCALE, target_cell_keys


class Selector(nn.Module):
    """The mask of Eq. 12 as a function of each token: m = sigmoid(score).

    The score starts as the heatmap logit of the token minus a penalty for redundancy, which counts the sender's own higher-scored
    tokens that propose the same cell. A learned function of the token is added.
    """

    def __init__(self, channels: int, hidden: int = 64) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(channels + PROPOSAL_DIM + 1, hidden), nn.Linear(hidden, 1)
        self.redundancy_weight = nn.Parameter(torch.tensor(-2.0, device="cpu"))
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)

    def forward(self, tokens: SparseBev) -> Tensor:
        """Map tokens (N, C + PROPOSAL_DIM) on one or more grids to logits (N,); no gradient reaches the tokens."""
        rows = tokens.features.detach()
        proposal = rows[:, -PROPOSAL_DIM:]
        heat = proposed_heat(proposal)
        rank = rank_in_group(target_cell_keys(tokens.sites.xy, proposal, tokens.sites.batch, tokens.grid), heat).log1p()
        inputs = torch.cat((rows[:, :-PROPOSAL_DIM], proposal * PROPOSAL_SCALE.to(proposal.device), rank[:, None]), 1)
        learned = self.outer(torch.relu(self.inner(inputs)))[:, 0]
        return heat + self.redundancy_weight * rank + learned


def rank_in_group(key: Tensor, value: Tensor) -> Tensor:
    """Count, for each element (N,), those of equal key with a higher value; ties by row, dtype of value."""
    by_value = value.sort(descending=True, stable=True).indices
    group, by_key = key[by_value].sort(stable=True)
    order = by_value[by_key]
    place = torch.arange(len(key), device=key.device)
    is_first = torch.cat((group[:1] == group[:1], group[1:] != group[:-1]))
    start = torch.where(is_first, place, 0).cummax(0).values if len(key) else place
    return torch.empty_like(value).index_copy_(0, order, (place - start).to(value.dtype))
