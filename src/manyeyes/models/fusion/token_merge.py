# SPDX-License-Identifier: Apache-2.0
"""Assign the tokens of several agents to the cells of their proposed object centres and merge the tokens of each
cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, Sites, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_offset, reset_origin
from manyeyes.models.fusion._merge_kernels import MergeColumns, MergeWeights, layer_pair, merge_tokens
from manyeyes.models.fusion._transform_kernels import assign
from manyeyes.models.fusion.transform_tokens import PROPOSAL_COLUMNS, Tokens, grid_cells, is_plain
from manyeyes.ops.sparse_index import distinct
from manyeyes.ops.voxelize import segment_max, segment_sum

MIN_VOTE_LOGIT = -3.0
"""Minimum heatmap logit with which a token moves to its proposed centre; other tokens stay in their cell."""
DRIFT_MPS = 1.0
"""Growth of a box's position sigma with its age: the residual velocity error."""
MAX_OFFSET_CELLS = 2.0
"""Maximum proposed offset, in cells, that a token follows; heads at stride 4 learn centres up to 1.5 cells away."""


@dataclass(frozen=True, eq=False)
class FusedBev:
    """One feature per cell (N, C) and the merged proposals (N, PROPOSAL_DIM) from which box refinement starts."""

    bev: SparseBev
    merged_proposals: Tensor

    def to(self, device: torch.device) -> FusedBev:
        """Return the same on a device."""
        return FusedBev(self.bev.to(device), self.merged_proposals.to(device))


@dataclass(frozen=True, eq=False)
class MergedProposals:
    """Merged boxes of the tokens of each cell, before features are fused.

    Attributes:
        sites: U cells.
        row: (N,) int64, the cell of each token.
        weight: (N, 1) of each token in its cell.
        proposals: (U, PROPOSAL_DIM).
        statistics: (U, C) to add to the fused features: number, joint score and spread of the tokens.
    """

    sites: Sites
    row: Tensor
    weight: Tensor
    proposals: Tensor
    statistics: Tensor

    def with_features(self, features: Tensor) -> FusedBev:
        """Return fused features (U, C) with the statistics added, and the merged proposals."""
        return FusedBev(SparseBev(features + self.statistics, self.sites), self.proposals)


def assign_cells(tokens: Tokens) -> tuple[Tensor, Tensor]:
    """Return the key (N,) of the cell of each token, and the token's offset (N, 2) from that cell's centre, in cells."""
    if is_plain(tokens.xy, tokens.proposal):
        key, cell_offset = (
            tokens.xy.new_empty(len(tokens.xy), dtype=torch.int64),
            tokens.xy.new_empty(len(tokens.xy), 2),
        )
        xy, proposal = tokens.xy.contiguous().numpy(), tokens.proposal.contiguous().numpy()
        votes = (MIN_VOTE_LOGIT, MAX_OFFSET_CELLS)
        grid, ego = grid_cells(tokens.grid), tokens.ego.contiguous().numpy()
        assign(xy, proposal, ego, PROPOSAL_COLUMNS, votes, grid, key.numpy(), cell_offset.numpy())
        return key, cell_offset
    key = target_cell_keys(tokens.xy, tokens.proposal, tokens.ego, tokens.grid)
    rows, columns = tokens.grid.shape
    within = key.remainder(rows * columns)
    yx = torch.stack((within.div(columns, rounding_mode="floor"), within.remainder(columns)), -1)
    return key, (tokens.xy - tokens.grid.centers(yx)) / tokens.grid.cell_size_m


def target_cell_keys(xy: Tensor, proposal: Tensor, grid_of: Tensor, grid: BevGrid) -> Tensor:
    """Return ``(grid_of * rows + row) * columns + column`` (N,) int64 of the target cell of tokens at xy (N, 2)."""
    offset = proposed_offset(proposal)
    votes = (proposed_heat(proposal) > MIN_VOTE_LOGIT) & (offset.abs().amax(1) <= MAX_OFFSET_CELLS)
    goal = xy + offset * votes[:, None] * grid.cell_size_m
    goal = torch.where(grid.contains(goal)[:, None], goal, xy)
    rows, columns = grid.shape
    yx = grid.cells(goal)
    return (grid_of * rows + yx[:, 0]) * columns + yx[:, 1]


class TokenMerge(nn.Module):
    """Merge the tokens of a cell: softmax-weighted mean or maximum of features, softmax-weighted mean of boxes.

    The softmax runs within a cell, over a learned function of proposal (heatmap, IoU, log sigma) and feature. It starts as heatmap
    logit plus IoU logit minus log sigma. Sigma combines the box error, the position error of the sender's pose and the drift since
    the observation. The number of tokens, their joint score and the spread of their boxes are added to the feature, as a mean loses
    them.
    """

    def __init__(self, channels: int, reduce: Literal["softmax", "max"]) -> None:
        super().__init__()
        self.reduce = reduce
        self.proposal_weight, self.feature_weight = nn.Linear(3, 1, bias=False), nn.Linear(channels, 1, bias=False)
        self.inner = nn.Linear(BOX_LAYOUT.velocity.start + 4, 2 * channels)
        self.outer = nn.Linear(2 * channels, channels, bias=False)
        with torch.no_grad():
            self.proposal_weight.weight.copy_(torch.tensor([[1.0, 1.0, -1.0]], device="cpu"))
        nn.init.zeros_(self.feature_weight.weight)
        self.folded: MergeWeights | None = None

    def fold(self, in_bfloat16: bool = False) -> None:
        """Copy the weights permanently to one compiled call, in float32; those of the layers are unused afterwards."""
        layers = layer_pair(self.inner, self.outer)
        if layers is not None and self.reduce == "softmax":
            on_proposal, on_feature = (
                layer.weight.detach().float().flatten().numpy().copy()
                for layer in (self.proposal_weight, self.feature_weight)
            )
            self.folded = MergeWeights(layers, on_proposal, on_feature, PROPOSAL_SCALE.numpy())

    def forward(self, features: Tensor, tokens: Tokens, key: Tensor, cell_offset: Tensor) -> FusedBev:
        """Merge features (N, C) of tokens on cells key (N,), at cell_offset (N, 2) from their centres."""
        rows, columns = tokens.grid.shape
        inputs = (features, tokens.proposal, cell_offset, tokens.pose_context)
        if self.folded is not None and is_plain(*inputs, tokens.selection_mask):
            x, proposal, offset, context = (t.contiguous().numpy() for t in inputs)
            size, drift = tokens.batch_size * rows * columns, DRIFT_MPS * 0.1
            merged = merge_tokens(x, proposal, offset, context, drift, key.numpy(), size, self.folded, _MERGE_COLUMNS)
            found, features, merged_proposals = map(torch.from_numpy, merged)
            return FusedBev(SparseBev(features, Sites(found, tokens.grid, tokens.batch_size)), merged_proposals)
        merged = self.merge_proposals(features, tokens, key, cell_offset)
        row, n = merged.row, len(merged.sites)
        features = features * tokens.selection_mask[:, None]
        if self.reduce == "max":
            reduced = segment_max(features, row, n)
        else:
            reduced = segment_sum(merged.weight * features, row, n)
        return merged.with_features(reduced)

    def merge_proposals(self, features: Tensor, tokens: Tokens, key: Tensor, cell_offset: Tensor) -> MergedProposals:
        """Merge all but the features (N, C), which enter the weights alone; arguments as of forward."""
        rows, columns = tokens.grid.shape
        found, row = distinct(key, tokens.batch_size * rows * columns)
        n = found.shape[0]
        boxes = reset_origin(tokens.proposal, cell_offset)
        moved = DRIFT_MPS * 0.1 * tokens.age
        blur = (
            boxes[:, BOX_LAYOUT.log_sigma_xy].clamp(-5, 3).exp() ** 2 + (tokens.sigma_m**2 + moved**2)[:, None]
        ).log() / 2
        proposal_terms = torch.cat((boxes[:, BOX_LAYOUT.heatmap_logit], boxes[:, BOX_LAYOUT.iou_logit], blur), 1)
        logit = (self.proposal_weight(proposal_terms) + self.feature_weight(features))[
            :, 0
        ] + tokens.selection_mask.log()
        weight = _softmax(logit, row, n)[:, None]
        merged_proposals = segment_sum(weight * boxes, row, n)
        score = torch.sigmoid(boxes[:, BOX_LAYOUT.heatmap_logit])
        away = (boxes[:, BOX_LAYOUT.offset] - merged_proposals[row][:, BOX_LAYOUT.offset]) ** 2
        met = segment_sum(torch.cat((torch.ones_like(score), score), 1), row, n).log1p()
        apart = segment_sum(weight * away, row, n).clamp_max(1)
        statistics = torch.cat(
            ((merged_proposals * PROPOSAL_SCALE.to(features.device))[:, : BOX_LAYOUT.velocity.start], met, apart), 1
        )
        sites = Sites(found, tokens.grid, tokens.batch_size)
        return MergedProposals(sites, row, weight, merged_proposals, self.outer(torch.relu(self.inner(statistics))))


def _proposal_scale() -> Tensor:
    scale = torch.ones(PROPOSAL_DIM, device="cpu")
    for logits in (BOX_LAYOUT.heatmap_logit, BOX_LAYOUT.iou_logit, BOX_LAYOUT.class_logits, BOX_LAYOUT.direction):
        scale[logits] = 0.25
    return scale


_MERGE_COLUMNS = MergeColumns(
    BOX_LAYOUT.heatmap_logit.start,
    BOX_LAYOUT.iou_logit.start,
    BOX_LAYOUT.log_sigma_xy.start,
    BOX_LAYOUT.offset.start,
    BOX_LAYOUT.velocity.start,
)
PROPOSAL_SCALE = _proposal_scale()
"""Scale of each proposal column that brings its logits to a few units."""


def _softmax(logit: Tensor, row: Tensor, n: int) -> Tensor:
    peak = logit.detach().new_full((n,), -torch.inf).scatter_reduce(0, row, logit.detach(), "amax")
    weight = (logit - peak[row]).exp()
    return weight / segment_sum(weight, row, n)[row]
