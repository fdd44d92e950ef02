# SPDX-License-Identifier: Apache-2.0
"""How2comm (Yang et al., NeurIPS 2023): spatial gates of what is requested, and exclusive and common features fused apart.

A row of a collaborator is cut where the gate of the ego's request and of its own attention is closed; the cut is
straight-through, so that the loss trains the gate. Here the gate acts at the receiver; bytes are saved by the selections of
strategies. Attention to deformable points is attention to the nearest rows within two cells. Of the paper's compensation of delays
the velocities of the senders remain, in mode inside; channel masks, history of the ego and the loss on mutual information are not
part of it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion._layers import PlainConv
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule
from manyeyes.ops.nearest_rows import nearest_rows

MIN_SHARE = 0.01
"""Gates and shares of confidence below this one are closed."""
NUM_EXCLUSIVE, NUM_COMMON = 9, 3
"""Nearest rows that a cell attends to."""
REACH_CELLS = 2.0


class SpatialGate(nn.Module):
    """S = sigmoid(w [1 - A_0 ; A_j]) of each row, with the spatial attention A = sigmoid(conv3x3([mean_C ; max_C])) of a map.

    A cell that the ego does not see is requested whole: A_0 = 0.
    """

    def __init__(self) -> None:
        super().__init__()
        self.attention, self.combine = PlainConv(2, 1), nn.Linear(2, 1)

    def forward(self, rows: CellRows) -> Tensor:
        """Return the gates (M, 1) in [0, 1]."""
        maps = rows.to_maps()
        summary = torch.stack((maps.features.mean(1), maps.features.amax(1)), 1)
        attention = maps.to_rows(torch.sigmoid(self.attention(SparseBev(summary, maps.sites))))
        request = 1 - rows.own_features(attention)[rows.cell]
        return torch.sigmoid(self.combine(torch.cat((request, attention), 1)))


class NearestAttention(nn.Module):
    """Multi-head attention of cells to the nearest rows in reach; zero where there are none."""

    def __init__(self, channels: int, heads: int, count: int) -> None:
        super().__init__()
        self.heads, self.count = heads, count
        self.query, self.key, self.value, self.out = (nn.Linear(channels, channels, bias=False) for _ in range(4))
        self.place = nn.Linear(2, channels, bias=False)

    def forward(self, own: Tensor, rows: CellRows, features: Tensor, kept: Tensor) -> Tensor:
        """Attend from the ego's features (U, C) to features (n, C) of the rows kept (n,) int64; returns (U, C)."""
        sites, cell_m = rows.sites, rows.sites.grid.cell_size_m
        xy, batch = rows.xy[kept], rows.agent[kept].div(rows.num_senders, rounding_mode="floor")
        found = nearest_rows(sites.xy, sites.batch, xy, batch, self.count, REACH_CELLS * cell_m)
        cell, at = (found >= 0).nonzero(as_tuple=True)
        near = found[cell, at]
        offset = (xy[near] - sites.xy[cell]) / cell_m
        query, key, value = (
            x.view(len(x), self.heads, own.shape[1] // self.heads)
            for x in (
                self.query(own)[cell],
                (self.key(features)[near] + self.place(offset)),
                self.value(features)[near],
            )
        )
        logit = (query * key).sum(2) / math.sqrt(query.shape[2])
        full = logit.new_full((*found.shape, self.heads), -torch.inf).index_put((cell, at), logit)
        full = full.masked_fill((found < 0).all(1)[:, None, None], 0.0)
        weight = full.softmax(1)[cell, at]
        attended = (weight[:, :, None] * value).flatten(1)
        return self.out(own.new_zeros(own.shape).index_add(0, cell, attended))


@register_rule("how2comm")
class How2comm(nn.Module):
    """y = x_0 + g_e attend(exclusive) + g_k attend(common) of each cell, with gates g of two convolutions and a softmax.

    Of confidence c_j of a collaborator and c_0 of the ego on a cell, (1 - c_0) c_j is exclusive and c_0 c_j common.
    """

    sends_confidence = True

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.spatial = SpatialGate()
        self.exclusive = NearestAttention(channels, attention.heads, NUM_EXCLUSIVE)
        self.common = NearestAttention(channels, attention.heads, NUM_COMMON)
        self.gate_exclusive, self.gate_common = PlainConv(channels, 1), PlainConv(channels, 1)

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells; absent senders have no rows in either mode."""
        own, gate = rows.own_features(), self.spatial(rows)
        # Straight-through: a hard cut in the value, the gate in the gradient.
        passed = (gate > MIN_SHARE).to(gate.dtype) + gate - gate.detach()
        exclusive, common = split_confidence(rows)
        fused = [
            attend(own, rows, (rows.features * passed * share[:, None])[kept], kept)
            for attend, share in ((self.exclusive, exclusive), (self.common, common))
            for kept in [(~rows.is_own & (share > MIN_SHARE)).nonzero()[:, 0]]
        ]
        gates = torch.cat(
            [gate(SparseBev(x, rows.sites)) for gate, x in zip((self.gate_exclusive, self.gate_common), fused)], 1
        ).softmax(1)
        return own + gates[:, :1] * fused[0] + gates[:, 1:] * fused[1]


def split_confidence(rows: CellRows) -> tuple[Tensor, Tensor]:
    """Return the exclusive and the common share (M,) of the confidence of each row; they add up to it."""
    own = rows.own_features(rows.confidence[:, None])[rows.cell, 0]
    return (1 - own) * rows.confidence, own * rows.confidence
