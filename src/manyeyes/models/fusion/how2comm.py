# SPDX-License-Identifier: Apache-2.0
"""How2comm (Yang et al., NeurIPS 2023): spatial gates of what is requested, and exclusive and common features fused apart.

A row of a collaborator is cut where the gate of the ego's request and of its own attention is closed. The sender cuts, by the
strategy ``intermediate-how2comm``; in training the same gate cuts what arrives, straight-through, so that the loss trains it, with
the ego's request of the same instant and of each cell. Attention to deformable points is attention to the nearest rows within two
cells. Instead of a flow that the receiver estimates, the sender states the velocity of each row, in mode bare too. Channel masks,
history of the ego and the loss on mutual information are not part of it.
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
from manyeyes.ops.sparse_conv import submanifold_conv

MIN_SHARE = 0.01
"""Gates and shares of confidence below this one are closed."""
NUM_EXCLUSIVE, NUM_COMMON = 9, 3
"""Nearest rows that a cell attends to."""
REACH_CELLS = 2.0
GAUSSIAN_CELLS = 5


class SpatialGate(nn.Module):
    """S = smooth(sigmoid(w [1 - A_0 ; A_j])) smooth(sigmoid(mean_C x_j)) of each row.

    A = sigmoid(conv3x3([mean_C ; max_C])) is the spatial attention of a map; a cell that the ego does not see is requested whole:
    A_0 = 0. Values are smoothed by a Gaussian over the occupied ones of 5 x 5 cells of a map.
    """

    def __init__(self) -> None:
        super().__init__()
        self.attention, self.combine = PlainConv(2, 1), nn.Linear(2, 1)

    def attend(self, rows: CellRows) -> Tensor:
        """Return the spatial attention (M, 1) of the map of each sender."""
        maps = rows.to_maps()
        summary = torch.stack((maps.features.mean(1), maps.features.amax(1)), 1)
        return maps.to_rows(torch.sigmoid(self.attention(SparseBev(summary, maps.sites))))

    def open(self, rows: CellRows, request: Tensor, attention: Tensor) -> Tensor:
        """Return the gates (M, 1) in [0, 1] of requests 1 - A_0 (M, 1) and the senders' own attention (M, 1)."""
        gate = torch.sigmoid(self.combine(torch.cat((request, attention), 1)))
        maps = rows.to_maps()
        both = torch.cat((gate[maps.row], torch.sigmoid(maps.features.mean(1, keepdim=True))), 1)
        smoothed = _smooth(SparseBev(both, maps.sites))
        return maps.to_rows(smoothed[:, :1] * smoothed[:, 1:])

    def forward(self, rows: CellRows) -> Tensor:
        """Return the gates (M, 1) of the rows, requested by the ego among them."""
        attention = self.attend(rows)
        return self.open(rows, 1 - rows.own_features(attention)[rows.cell], attention)


def _smooth(x: SparseBev) -> Tensor:
    """Return each column of (N, D) smoothed over the occupied ones of 5 x 5 cells by a Gaussian of one cell."""
    at = torch.arange(GAUSSIAN_CELLS, device=x.features.device, dtype=x.features.dtype) - GAUSSIAN_CELLS // 2
    line = torch.exp(-0.5 * at**2)
    kernel = (line[:, None] * line / line.sum() ** 2)[None, None]
    columns = [*x.features.unbind(1), torch.ones_like(x.features[:, 0])]
    *sums, total = (submanifold_conv(x.with_features(column[:, None]), kernel).features for column in columns)
    return torch.cat(sums, 1) / total


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

    Of confidence c_j of a collaborator and c_0 of the ego on a cell, (1 - c_0) c_j is exclusive and c_0 c_j common. Outside of
    training all rows pass: their senders have cut them.
    """

    sends_confidence = sends_velocity = True

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.spatial = SpatialGate()
        self.exclusive = NearestAttention(channels, attention.heads, NUM_EXCLUSIVE)
        self.common = NearestAttention(channels, attention.heads, NUM_COMMON)
        self.gate_exclusive, self.gate_common = PlainConv(channels, 1), PlainConv(channels, 1)

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells; absent senders have no rows in either mode."""
        own, passed = rows.own_features(), rows.features.new_ones(len(rows.cell), 1)
        if self.training:
            # Straight-through: a hard cut in the value, the gate in the gradient.
            gate = self.spatial(rows)
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
