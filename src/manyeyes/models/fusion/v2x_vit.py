# SPDX-License-Identifier: Apache-2.0
"""V2X-ViT fusion (Xu et al., ECCV 2022, section 3.2) on sparse tokens: heterogeneous multi-agent attention, then
multi-scale window attention.

The paper uses dense maps of all agents; here an agent has one row on each cell where it has a token, agents attend to each other on
a cell, and windows hold the rows of one agent. Agent types are vehicle and roadside unit. There are as many layers as the attention
has blocks (paper: 3), without drop-out, and positions in windows are sines instead of a table. Inside, the delay-aware positional
encoding is SpatioTemporalEncoding, layers end in zeros at the start, and the rows are merged by TokenMerge; bare, the encoding is
that of the age alone, and the ego's row of every cell is the result.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows, gather_by_cell
from manyeyes.models.fusion.cell_fusion import register_bare
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding, temporal_encoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.voxelize import segment_sum
from manyeyes.ops.window_attention import plan_windows, sincos_encoding, window_attention, window_ids, window_offsets

NUM_AGENT_TYPES = 2
"""Agent types: vehicles, and roadside units."""


class PerAgentType(nn.Module):
    """A separate linear layer for each agent type (the paper's Dense_c)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.maps = nn.ModuleList(nn.Linear(channels, channels) for _ in range(NUM_AGENT_TYPES))

    def forward(self, features: Tensor, agent_type: Tensor) -> Tensor:
        """Map features (N, C) of agent types (N,) to (N, C)."""
        return torch.stack([each(features) for each in self.maps])[
            agent_type, torch.arange(len(agent_type), device=agent_type.device)
        ]


class AgentAttention(nn.Module):
    """Heterogeneous attention between the rows of one cell: projections per agent type, and a matrix per head and edge type in
    logits and messages.

    One softmax covers all keys although the matrices differ by edge type. Keys and values are stored side by side for queries of
    either type, and a query is zero in the columns of the other type.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (PerAgentType(channels) for _ in range(4))
        d = channels // heads
        same = torch.eye(d, device="cpu").expand(NUM_AGENT_TYPES, NUM_AGENT_TYPES, heads, d, d)
        self.attention_matrix, self.message_matrix = nn.Parameter(same.clone()), nn.Parameter(same.clone())

    def forward(self, features: Tensor, key: Tensor, agent_type: Tensor) -> Tensor:
        """Map features (N, C) of agent types (N,) to (N, C); rows with equal key (N,) attend to each other."""

        def split(x: Tensor) -> Tensor:
            return x.unflatten(1, (self.heads, -1))

        def to_both(x: Tensor, by_edge: Tensor) -> Tensor:
            """Transform x (N, heads, d) for queries of each agent type: (N, heads, NUM_AGENT_TYPES * d)."""
            return torch.einsum("nhd,qnhde->nhqe", x, by_edge[:, agent_type]).flatten(2)

        query = split(self.query(features, agent_type))
        one_hot = torch.nn.functional.one_hot(agent_type, NUM_AGENT_TYPES).to(query.dtype)
        # Scale for the width of one head, not for the doubled width.
        query = (query[:, :, None] * one_hot[:, None, :, None]).flatten(2) * NUM_AGENT_TYPES**0.5
        keys = to_both(split(self.key(features, agent_type)), self.attention_matrix)
        messages = to_both(split(self.value(features, agent_type)), self.message_matrix)
        attended = window_attention(query, keys, messages, plan_windows(key, key)).unflatten(2, (NUM_AGENT_TYPES, -1))
        return self.out(
            attended[torch.arange(len(agent_type), device=agent_type.device), :, agent_type].flatten(1), agent_type
        )


class WindowScale(nn.Module):
    """Attention among the rows of one agent in windows of one size."""

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        self.qkv, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)

    def forward(self, features: Tensor, xy: Tensor, agent: Tensor, grid: BevGrid) -> Tensor:
        """Map features (N, C) at xy (N, 2), metres, of agents (N,) to (N, C)."""
        cell, origin = grid.cell_size_m, (grid.x_min, grid.y_min)
        ids = window_ids(xy, agent, origin, self.window * cell)
        place = sincos_encoding(window_offsets(xy, origin, self.window * cell, cell), features.shape[1])
        # The position encoding enters queries and keys, not values.
        weight, bias = self.qkv.weight, self.qkv.bias
        query, key, value = (
            torch.nn.functional.linear(x, w, b).unflatten(1, (self.heads, -1))
            for x, w, b in zip((features + place, features + place, features), weight.chunk(3), bias.chunk(3))
        )
        return self.out(window_attention(query, key, value, plan_windows(ids, ids)).flatten(1))


class MultiScaleWindows(nn.Module):
    """Windows of half, one and two times the width, combined by split attention.

    Smaller windows have more heads. The scale weights are a channel-wise softmax of a function of each agent's mean
    summed feature.
    """

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        shapes = (
            (config.heads * 2, config.window // 2),
            (config.heads, config.window),
            (config.heads // 2, config.window * 2),
        )
        self.scales = nn.ModuleList(WindowScale(channels, heads, window) for heads, window in shapes)
        self.inner, self.norm = nn.Linear(channels, channels), nn.LayerNorm(channels)
        self.outer = nn.Linear(channels, len(shapes) * channels)

    def forward(self, features: Tensor, xy: Tensor, agent: Tensor, agents: int, grid: BevGrid) -> Tensor:
        """Map features (N, C) at xy (N, 2), metres, of agents (N,) to (N, C); agents: the number of agents."""
        scales = torch.stack([scale(features, xy, agent, grid) for scale in self.scales], 1)
        count = segment_sum(scales.new_ones(len(agent), 1), agent, agents).clamp_min(1)
        mean = segment_sum(scales.sum(1), agent, agents) / count
        share = self.outer(torch.relu(self.norm(self.inner(mean)))).unflatten(1, (len(self.scales), -1)).softmax(1)
        return (share[agent] * scales).sum(1)


class V2xVitLayer(nn.Module):
    """One layer: agent attention, window attention, feed-forward network; pre-norm, residual."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.agent_attention, self.window_attention = (
            AgentAttention(channels, config.heads),
            MultiScaleWindows(channels, config),
        )
        hidden = channels * config.expansion
        self.ffn = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels))

    def forward(self, rows: CellRows) -> CellRows:
        """Return the rows with new features."""
        between, within, alone = self.norms
        agents, grid = rows.sites.batch_size * rows.num_senders, rows.sites.grid
        features = rows.features
        features = features + self.agent_attention(between(features), rows.cell, rows.infrastructure.long())
        features = features + self.window_attention(within(features), rows.xy, rows.agent, agents, grid)
        return rows.with_features(features + self.ffn(alone(features)))

    def silence(self) -> None:
        """Set the last layer of each branch to zero: the layer returns its input."""
        last = [scale.get_submodule("out") for scale in self.window_attention.scales]
        for module in (self.agent_attention.out, *last, self.ffn[2]):
            for parameter in module.parameters():
                nn.init.zeros_(parameter)


def _make_layers(channels: int, config: AttentionConfig) -> list[V2xVitLayer]:
    if config.heads % 2 or config.window % 2 or channels % (2 * config.heads):
        raise ConfigError(
            "V2X-ViT needs even heads and window, and channels divisible by twice the heads; got "
            f"{config.heads}, {config.window} and {channels}."
        )
    return [V2xVitLayer(channels, config) for _ in range(config.blocks)]


@register_fusion("v2x-vit")
class V2xVitFusion(nn.Module):
    """Mode inside: V2X-ViT layers on one row a sender and cell, then TokenMerge with softmax weights as in the other fusions."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "softmax")
        layers = _make_layers(channels, config)
        for layer in layers:
            layer.silence()
        self.layers = nn.ModuleList(layers)

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        rows, row_of_token = gather_by_cell(self.encoding(tokens.features, tokens, place), tokens, key)
        for layer in self.layers:
            rows = layer(rows)
        return self.merge(rows.features[row_of_token], tokens, key, place)


@register_bare("v2x-vit")
class V2xVitRule(nn.Module):
    """Mode bare: the encoding of delays and V2X-ViT layers; the ego's row of every cell, where it has no feature one of zeros."""

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.delay = nn.Linear(channels, channels, bias=False)
        self.layers = nn.ModuleList(_make_layers(channels, attention))

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        full = rows.with_own_everywhere()
        full = full.with_features(full.features + self.delay(temporal_encoding(full.age, full.features.shape[1])))
        for layer in self.layers:
            full = layer(full)
        return full.own_features()
