# SPDX-License-Identifier: Apache-2.0
"""Window attention over tokens at continuous metric positions: the block of DAST (CoSTr Eq. 4 to 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.ops.window_attention import plan_windows, sincos_encoding, window_attention, window_ids, window_offsets
from manyeyes.ops.window_loops import attend_in_windows, window_runs


@dataclass(frozen=True)
class AttentionConfig:
    """window: edge S of a window in cells of the token grid; blocks alternate regular and shifted windows."""

    window: int = 8
    blocks: int = 2
    heads: int = 4
    expansion: int = 2


class WindowBlock(nn.Module):
    """Pre-norm attention within a window and a feed-forward net, both residual (Eq. 6, 7).

    The relative position encoding (Eq. 4) enters queries and keys, measured from the middle of the window that is in force,
    shifted or not. Weights are shared by all density levels (Eq. 5); padding buckets are an affair of ``ops`` alone.
    """

    def __init__(self, channels: int, config: AttentionConfig, shifted: bool) -> None:
        super().__init__()
        if channels % (4 * config.heads):
            raise ConfigError(
                f"Attention needs channels divisible by 4 * heads; got {channels} and {config.heads} heads."
            )
        self.heads, self.window, self.shifted = config.heads, config.window, shifted
        self.norm, self.norm_ffn = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.query, self.key, self.value = (nn.Linear(channels, channels) for _ in range(3))
        self.out = nn.Linear(channels, channels)
        hidden = channels * config.expansion
        self.ffn = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels))

    def forward(
        self, features: Tensor, xy: Tensor, batch: Tensor, grid: BevGrid, cache: dict[Any, Any] | None = None
    ) -> Tensor:
        """features (N, C) of tokens at xy (N, 2), metres, in grids batch (N,), to (N, C).

        cache: of the sites that xy and batch belong to, where they belong to any: their windows are found once.
        """
        cache = {} if cache is None else cache
        name = ("windows", self.window, self.shifted)
        if name not in cache:
            edge = self.window * grid.cell
            origin, shift = (grid.x_min, grid.y_min), edge / 2 if self.shifted else 0.0
            offsets = window_offsets(xy, origin, edge, grid.cell, shift)
            cache[name] = window_ids(xy, batch, origin, edge, shift), offsets
        ids, offsets = cache[name]
        place = (*name, features.shape[1])
        if place not in cache:
            cache[place] = sincos_encoding(offsets, features.shape[1])
        normed = self.norm(features)
        placed = normed + cache[place]

        def split(x: Tensor) -> Tensor:
            return x.view(x.shape[0], self.heads, x.shape[1] // self.heads)

        attended = _attend(split(self.query(placed)), split(self.key(placed)), split(self.value(normed)), ids)
        features = features + self.out(attended.flatten(1))
        return features + self.ffn(self.norm_ffn(features))


def _attend(query: Tensor, key: Tensor, value: Tensor, ids: Tensor) -> Tensor:
    """Attention of (N, heads, C / heads) within windows ids (N,)."""
    if not torch.is_grad_enabled() and query.device.type == "cpu" and query.dtype == torch.float32:
        return attend_in_windows(query, key, value, window_runs(ids))
    return window_attention(query, key, value, plan_windows(ids, ids))


class WindowTransformer(nn.Module):
    """Blocks with regular and shifted windows in turn."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(WindowBlock(channels, config, shifted=bool(i % 2)) for i in range(config.blocks))

    def forward(
        self, features: Tensor, xy: Tensor, batch: Tensor, grid: BevGrid, cache: dict[Any, Any] | None = None
    ) -> Tensor:
        """(N, C) to (N, C); see WindowBlock."""
        for block in self.blocks:
            features = block(features, xy, batch, grid, cache)
        return features
