# SPDX-License-Identifier: Apache-2.0
"""SparseAlign's fusion (Yuan et al., CVPR 2025): every occupied cell takes the eight nearest queries of all agents.

A query is a row of a sender at its continuous position. ``rotate_vectors`` has turned its vector channels to the ego's frame, in
place of the paper's network on feature and rotation. Encoder, memory and pose alignment of the paper are not part of it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule
from manyeyes.ops.nearest_rows import nearest_rows

NUM_NEAREST = 8
MAX_DISTANCE_CELLS = 4.0
"""Queries farther away are left out."""


@register_rule("sparsealign")
class SparseAlign(nn.Module):
    """Maximum plus mean over the nearest queries of LeakyReLU(norm(linear([feature ; embedded offset])))."""

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.embed, self.mix = nn.Linear(2, channels), nn.Linear(2 * channels, channels)
        self.norm = ActiveNorm(channels)

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells; absent senders have no queries in either mode."""
        cell_m, sites = rows.sites.grid.cell_size_m, rows.sites
        batch = rows.agent.div(rows.num_senders, rounding_mode="floor")
        found = nearest_rows(sites.xy, sites.batch, rows.xy, batch, NUM_NEAREST, MAX_DISTANCE_CELLS * cell_m)
        cell, place = (found >= 0).nonzero(as_tuple=True)
        query = found[cell, place]
        offset = (rows.xy[query] - sites.xy[cell]) / cell_m
        mixed = self.mix(torch.cat((rows.features[query], self.embed(offset)), 1))
        mixed = nn.functional.leaky_relu(self.norm(mixed))
        n, channels = found.shape[0], mixed.shape[1]
        padded = mixed.new_zeros(n, found.shape[1], channels).index_put((cell, place), mixed)
        is_found = (found >= 0)[:, :, None]
        largest = padded.masked_fill(~is_found, torch.finfo(padded.dtype).min).amax(1)
        # A cell without a query in reach is zero.
        return is_found.any(1) * (largest + padded.sum(1) / is_found.sum(1).clamp_min(1))
