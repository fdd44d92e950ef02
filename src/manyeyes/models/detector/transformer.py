# SPDX-License-Identifier: Apache-2.0
"""Window attention over tokens at continuous metric positions: the block of DAST (CoSTr Eq. 4 to 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, LayerCount, StageCount
from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.ops._attention_block_kernels import BlockWeights, run_block
from manyeyes.ops._window_attention_kernels import attend_in_windows, window_runs
from manyeyes.ops.window_attention import (
    WindowPlan,
    plan_windows,
    sincos_encoding,
    window_attention,
    window_ids,
    window_places,
)


@dataclass(frozen=True)
class AttentionConfig:
    """Settings of window attention.

    Attributes:
        window: edge S of a window, in cells of the token grid.
        blocks: number of blocks, with regular and shifted windows in turn.
        density_thresholds: fractions of S^2 up to which the number of tokens is Low, and Medium; above it is High
            (Eq. 5).
        separate_weights: use separate weights per density level, as in the paper.
    """

    window: StageCount = 8
    blocks: LayerCount = 2
    heads: ChannelCount = 4
    expansion: StageCount = 2
    density_thresholds: tuple[float, float] = (0.125, 0.25)
    separate_weights: bool = False

    def __post_init__(self) -> None:
        low, medium = self.density_thresholds
        if not 0 <= low <= medium:
            raise ConfigError(
                "AttentionConfig.density_thresholds are two ascending fractions of a window's cells; got "
                f"{self.density_thresholds}."
            )


class WindowBlock(nn.Module):
    """Pre-norm attention within a window and a feed-forward network, both residual (Eq. 6, 7).

    The relative position encoding (Eq. 4) enters queries and keys, measured from the centre of the regular or shifted window.
    Padding is internal to ``ops``.
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
        self.folded: BlockWeights | None = None

    def forward(
        self, features: Tensor, xy: Tensor, batch: Tensor, grid: BevGrid, cache: dict[Any, Any] | None = None
    ) -> Tensor:
        """Map features (N, C) of tokens at xy (N, 2), metres, in grids batch (N,), to (N, C).

        cache: of the sites that xy and batch belong to, if any, so that their windows are computed once.
        """
        cache = {} if cache is None else cache
        name = ("windows", self.window, self.shifted)
        if name not in cache:
            edge = self.window * grid.cell_size_m
            origin, shift = (grid.x_min, grid.y_min), edge / 2 if self.shifted else 0.0
            cache[name] = window_places(xy, batch, origin, edge, grid.cell_size_m, shift)
        ids, offsets = cache[name]
        if self.folded is not None and _plain(features):
            return run_block(features, offsets, window_runs(ids), self.folded)
        plan, plan_name = None, ("plan", *name)
        if not _is_compiled(features):
            plan = cache[plan_name] = cache[plan_name] if plan_name in cache else plan_windows(ids, ids)
        place = (*name, features.shape[1])
        if place not in cache:
            cache[place] = sincos_encoding(offsets, features.shape[1])
        normed = self.norm(features)
        placed = normed + cache[place]

        def split(x: Tensor) -> Tensor:
            return x.view(x.shape[0], self.heads, x.shape[1] // self.heads)

        attended = _attend(split(self.query(placed)), split(self.key(placed)), split(self.value(normed)), ids, plan)
        features = features + self.out(attended.flatten(1))
        return features + self.ffn(self.norm_ffn(features))

    def fold(self, in_bfloat16: bool = False) -> None:
        """Copy the weights permanently to one compiled call; those of the layers are unused afterwards."""
        linears = [self.query, self.key, self.value, self.out, self.ffn[0], self.ffn[2]]
        self.folded = BlockWeights.of(linears, [self.norm, self.norm_ffn], self.heads, in_bfloat16)


class RoutedBlock(nn.Module):
    """Three attention blocks, one each for windows of Low, Medium and High density (Eq. 5).

    All tokens of a window use the weights of its level, so one more token may change the weights of all of them.
    """

    def __init__(self, channels: int, config: AttentionConfig, shifted: bool) -> None:
        super().__init__()
        self.config, self.shifted = config, shifted
        self.levels = nn.ModuleList(WindowBlock(channels, config, shifted) for _ in range(3))

    def forward(
        self, features: Tensor, xy: Tensor, batch: Tensor, grid: BevGrid, cache: dict[Any, Any] | None = None
    ) -> Tensor:
        """Map (N, C) to (N, C), see WindowBlock; cache is unused, because each level has its own tokens."""
        edge = self.config.window * grid.cell_size_m
        ids = window_ids(xy, batch, (grid.x_min, grid.y_min), edge, edge / 2 if self.shifted else 0.0)
        level = density_levels(ids, self.config.window**2, self.config.density_thresholds)
        out = features
        for number, block in enumerate(self.levels):
            rows = (level == number).nonzero()[:, 0]
            if len(rows):
                out = out.index_copy(0, rows, block(features[rows], xy[rows], batch[rows], grid))
        return out


def density_levels(window: Tensor, cells: int, thresholds: tuple[float, float]) -> Tensor:
    """Return the density level (N,) int64 of each token's window (N,): 0 Low, 1 Medium, 2 High (CoSTr Eq. 5).

    Low: tokens / cells is at most thresholds[0]; Medium: at most thresholds[1]. Continuous positions allow more
    tokens than cells.
    """
    _, row, count = window.unique(return_inverse=True, return_counts=True)
    share = count[row].double() / cells
    return (share > thresholds[0]).long() + (share > thresholds[1]).long()


def _attend(query: Tensor, key: Tensor, value: Tensor, ids: Tensor, plan: WindowPlan | None) -> Tensor:
    """Attention of (N, heads, C / heads) within windows ids (N,), in compiled loops without a plan."""
    if plan is None:
        return attend_in_windows(query, key, value, window_runs(ids))
    return window_attention(query, key, value, plan)


def _plain(x: Tensor) -> bool:
    """Return whether compiled loops apply: no gradient is required, and the tensor is float32 on the CPU."""
    return not torch.is_grad_enabled() and _is_compiled(x)


def _is_compiled(x: Tensor) -> bool:
    """Return whether compiled attention applies, with gradients too."""
    return x.device.type == "cpu" and x.dtype == torch.float32


class WindowTransformer(nn.Module):
    """Blocks with regular and shifted windows in turn."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        block = RoutedBlock if config.separate_weights else WindowBlock
        self.blocks = nn.ModuleList(block(channels, config, shifted=bool(i % 2)) for i in range(config.blocks))

    def forward(
        self, features: Tensor, xy: Tensor, batch: Tensor, grid: BevGrid, cache: dict[Any, Any] | None = None
    ) -> Tensor:
        """Map (N, C) to (N, C); see WindowBlock."""
        for block in self.blocks:
            features = block(features, xy, batch, grid, cache)
        return features
