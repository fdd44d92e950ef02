# SPDX-License-Identifier: Apache-2.0
"""Object merge by distance: tokens of one object meet by the distance of their proposed centres, not on a common cell.

A border between cells separates two proposals that are centimetres apart, and the merge changes with the lattice. Here tokens with
sufficient heat form greedy groups in falling order of heat, and a group lies on the cell of its first token. Compare the matching
of instances by distance of INSTINCT (ICCV 2025) and SparseCoop (AAAI 2026).
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.detector.proposal import proposed_heat, proposed_offset
from manyeyes.models.fusion._instance_kernels import group_by_distance
from manyeyes.models.fusion.by_cell import standing_cells
from manyeyes.models.fusion.flow_aware import FastFusion
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import MAX_OFFSET_CELLS, MIN_VOTE_LOGIT, FusedBev, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens

RADIUS_M, MAX_RADIUS_M = 1.0, 2.0
"""A token joins a group within RADIUS_M plus the position sigma of its sender, at most MAX_RADIUS_M."""


def find_group_heads(tokens: Tokens) -> Tensor:
    """Return (N,) int64: the token that leads the group of each token; itself where it proposes no object.

    Groups depend on distances alone, so that they are the same on any lattice of the same cell size.
    """
    goal, votes = _goals(tokens)
    heat = proposed_heat(tokens.proposal).detach()
    head = torch.arange(len(heat), device="cpu")
    order = heat.argsort(descending=True, stable=True).cpu()
    order = order[votes.cpu()[order]]
    radius = (RADIUS_M + tokens.sigma_m).clamp_max(MAX_RADIUS_M)
    columns = (goal.detach().float().cpu().contiguous().numpy(), tokens.ego.cpu().contiguous().numpy(), order.numpy())
    group_by_distance(*columns, radius.detach().float().cpu().numpy(), head.numpy())
    return head.to(heat.device)


def assign_group_cells(tokens: Tokens) -> tuple[Tensor, Tensor]:
    """Return the key (N,) of the cell of each token's group, and the token's offset (N, 2) from its centre, in cells.

    The cell is that of the proposed centre of the head of the group; tokens that propose no object stay on their own.
    """
    rows, columns = tokens.grid.shape
    goal, votes = _goals(tokens)
    yx = tokens.grid.cells(goal)
    proposed = (tokens.ego * rows + yx[:, 0]) * columns + yx[:, 1]
    key = torch.where(votes, proposed[find_group_heads(tokens)], standing_cells(tokens))
    within = key.remainder(rows * columns)
    centre = tokens.grid.centers(
        torch.stack((within.div(columns, rounding_mode="floor"), within.remainder(columns)), -1)
    )
    return key, (tokens.xy - centre) / tokens.grid.cell_size_m


def _goals(tokens: Tokens) -> tuple[Tensor, Tensor]:
    """Return proposed centres (N, 2), metres, and whether a token proposes an object there (N,)."""
    offset = proposed_offset(tokens.proposal)
    goal = tokens.xy + offset * tokens.grid.cell_size_m
    is_near = offset.abs().amax(1) <= MAX_OFFSET_CELLS
    votes = (proposed_heat(tokens.proposal) > MIN_VOTE_LOGIT) & is_near & tokens.grid.contains(goal)
    return torch.where(votes[:, None], goal, tokens.xy), votes


@register_fusion("instances")
class InstanceFusion(FastFusion):
    """FAST whose tokens are merged by object instead of by cell."""

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents and the ego's past tokens to one feature and one box per group."""
        key, place = assign_group_cells(tokens)
        attended = self.transformer(self.encoding(tokens.features, tokens, place), tokens.xy, tokens.ego, tokens.grid)
        if past is not None and len(past.features):
            past_features = self.encoding(past.features, past, assign_cells(past)[1])
            attended = self.past_attention(attended, tokens, past_features, past)
        return self.merge(attended, tokens, key, place)
