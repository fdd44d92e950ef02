# SPDX-License-Identifier: Apache-2.0
"""ERMVP's fusion (Zhang et al., CVPR 2024): attention over all agents in windows, local and with a global query, then the mean.

Positions in windows are sines instead of a learned three-dimensional bias. There are three layers as in the paper, and no drop-out.
Its compression is that of the sender: clusters of features (``clusters``), which stand in a packet once
(``comms.cluster_payload``); proposals are sent for each token. Its correction of poses is the corrector ``feaco``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule
from manyeyes.models.fusion.clusters import ClusterCompression
from manyeyes.ops.voxelize import segment_mean
from manyeyes.ops.window_attention import plan_windows, sincos_encoding, window_attention

WINDOW_CELLS = 4
DEPTH = 3


class Attention(nn.Module):
    """Multi-head attention with projections; queries and keys hold their positions."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (nn.Linear(channels, channels) for _ in range(4))

    def forward(self, query: Tensor, x: Tensor, place: Tensor, query_group: Tensor, group: Tensor) -> Tensor:
        """Attend from queries (N, C) to rows (M, C) at encoded positions (M, C), of equal group (N,), (M,); returns (N, C)."""
        q, k, v = (t.unflatten(1, (self.heads, -1)) for t in (self.query(query), self.key(x + place), self.value(x)))
        return self.out(window_attention(q, k, v, plan_windows(query_group, group)).flatten(1))


class ErmvpLayer(nn.Module):
    """Local window attention, feed-forward, window attention with global queries, feed-forward; pre-norm, residual.

    The global query of a position in a window: the map of the ego is pooled to one cell a window, all of these attend to each
    other, and those at the same position of their own coarse windows are averaged.
    """

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.local, self.pooled, self.from_global = (Attention(channels, config.heads) for _ in range(3))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(4))
        hidden = channels * config.expansion
        self.ffns = nn.ModuleList(
            nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels)) for _ in range(2)
        )

    def forward(self, x: Tensor, rows: CellRows) -> Tensor:
        """Map features (M, C) of the rows to (M, C)."""
        first, second, third, fourth = self.norms
        inner, outer = self.ffns
        yx = rows.sites.yx[rows.cell]
        batch, (height, width) = rows.sites.batch[rows.cell], rows.sites.grid.shape
        across = -(-width // WINDOW_CELLS)
        coarse = yx.div(WINDOW_CELLS, rounding_mode="floor")
        window = (batch * -(-height // WINDOW_CELLS) + coarse[:, 0]) * across + coarse[:, 1]
        at = yx.remainder(WINDOW_CELLS)
        place = sincos_encoding((at - (WINDOW_CELLS - 1) / 2).to(x.dtype), x.shape[1])
        normed = first(x)
        x = x + self.local(normed + place, normed, place, window, window)
        x = x + inner(second(x))
        normed = third(x)
        query = self._global_queries(normed, window, coarse, batch)[batch, at[:, 0] * WINDOW_CELLS + at[:, 1]]
        x = x + self.from_global(query + place, normed, place, window, window)
        return x + outer(fourth(x))

    def _global_queries(self, x: Tensor, window: Tensor, coarse: Tensor, batch: Tensor) -> Tensor:
        """Return the queries (batch, WINDOW_CELLS^2, C) of all positions; zero where no coarse cell has the position."""
        size = int(batch.max()) + 1 if len(batch) else 0
        found, row = window.unique(return_inverse=True)
        pooled = segment_mean(x, row, len(found))
        first = torch.zeros_like(found).index_copy(0, row, torch.arange(len(row), device=row.device))
        at, scene = coarse[first].remainder(WINDOW_CELLS), batch[first]
        place = sincos_encoding((at - (WINDOW_CELLS - 1) / 2).to(x.dtype), x.shape[1])
        attended = self.pooled(pooled + place, pooled, place, scene, scene)
        slot = (scene * WINDOW_CELLS + at[:, 0]) * WINDOW_CELLS + at[:, 1]
        used, slot_row = slot.unique(return_inverse=True)
        means = segment_mean(attended, slot_row, len(used))
        queries = x.new_zeros(size * WINDOW_CELLS**2, x.shape[1]).index_copy(0, used, means)
        return queries.view(size, WINDOW_CELLS**2, x.shape[1])


@register_rule("ermvp")
class Ermvp(nn.Module):
    """Layers on the rows of all agents, the mean over agents, norm and a linear layer."""

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        if channels % attention.heads:
            raise ConfigError(f"ERMVP needs channels divisible by heads; got {channels} and {attention.heads}.")
        self.absent: AbsentSenders = absent
        self.compression = ClusterCompression(channels)
        self.layers = nn.ModuleList(ErmvpLayer(channels, attention) for _ in range(DEPTH))
        self.norm, self.out = nn.LayerNorm(channels), nn.Linear(channels, channels)

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        x = rows.features
        for layer in self.layers:
            x = layer(x, rows)
        count = rows.num_rows if self.absent == "masked" else rows.num_rows + rows.num_absent
        return self.out(self.norm(rows.sum(x) / count[:, None]))
