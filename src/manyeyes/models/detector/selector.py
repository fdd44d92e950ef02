# SPDX-License-Identifier: Apache-2.0
"""Which tokens are worth their bytes (CoSTr section III-E): one score a token, learned; a budget sends the highest."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat
from manyeyes.models.fusion.token_merge import PROPOSAL_SCALE, target_cell_keys


class Selector(nn.Module):
    """The mask of Eq. 12 as a function of each token: m = sigmoid(score).

    The score starts as the sender's confidence that the token is the middle of an object, less what it costs that others of
    its own tokens, surer than it, speak of the same object already: a second word on one vehicle is worth less than a first
    word on another. What is learned is added to it.
    """

    def __init__(self, channels: int, hidden: int = 64) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(channels + PROPOSAL_DIM + 1, hidden), nn.Linear(hidden, 1)
        self.redundancy_weight = nn.Parameter(torch.tensor(-2.0))
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)

    def forward(self, tokens: SparseBev) -> Tensor:
        """(N, C + PROPOSAL) on one grid or a batch of them to logits (N,); no gradient reaches what is told."""
        rows = tokens.features.detach()
        proposal = rows[:, -PROPOSAL_DIM:]
        heat = proposed_heat(proposal)
        rank = rank_in_group(target_cell_keys(tokens.sites.xy, proposal, tokens.sites.batch, tokens.grid), heat).log1p()
        inputs = torch.cat((rows[:, :-PROPOSAL_DIM], proposal * PROPOSAL_SCALE, rank[:, None]), 1)
        learned = self.outer(torch.relu(self.inner(inputs)))[:, 0]
        return heat + self.redundancy_weight * rank + learned


def rank_in_group(key: Tensor, value: Tensor) -> Tensor:
    """(N,) how many of the same key have a higher value, ties by row, as value's type."""
    by_value = value.sort(descending=True, stable=True).indices
    group, by_key = key[by_value].sort(stable=True)
    order = by_value[by_key]
    count = torch.unique_consecutive(group, return_counts=True)[1]
    start = torch.repeat_interleave(count.cumsum(0) - count, count)
    rank = torch.empty_like(value)
    rank[order] = (torch.arange(len(key), device=key.device) - start).to(value.dtype)
    return rank
