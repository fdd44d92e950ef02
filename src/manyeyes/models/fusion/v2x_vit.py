# SPDX-License-Identifier: Apache-2.0
"""V2X-ViT's fusion (Xu et al., ECCV 2022, section 3.2) on sparse tokens: heterogeneous attention between agents at one place,
then attention of each over windows of several sizes.

Its maps have every agent's feature at every cell; here agents meet on the cells where their tokens come to rest. Its kinds of
agents are vehicle and roadside unit; a token does not say what sent it, and in the towns all are vehicles, so that kinds here are
the ego itself and whom it hears. Its delay-aware encoding of positions is Placement's; its warp is that of gather.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.voxelize import segment_sum
from manyeyes.ops.window_attention import plan_windows, sincos_encoding, window_attention, window_ids, window_offsets

NUM_AGENT_TYPES = 2
"""The ego's own tokens, and those that it heard."""


class PerAgentType(nn.Module):
    """A linear map of its own for each kind of agent (the paper's Dense_c)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.maps = nn.ModuleList(nn.Linear(channels, channels) for _ in range(NUM_AGENT_TYPES))

    def forward(self, features: Tensor, agent_type: Tensor) -> Tensor:
        """(N, C) of agents of kind (N,) to (N, C)."""
        return torch.stack([each(features) for each in self.maps])[
            agent_type, torch.arange(len(agent_type), device=agent_type.device)
        ]


class AgentAttention(nn.Module):
    """Attention between tokens at one place: queries, keys and values by the kind of their agent, and a matrix a head for each
    kind of edge, in the logits and in the messages.

    The softmax runs over all keys at once although the matrices differ by edge: keys and values are held as what they mean to
    a query of either kind, side by side, and a query is zero on the other kind's side.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value, self.out = (PerAgentType(channels) for _ in range(4))
        d = channels // heads
        same = torch.eye(d).expand(NUM_AGENT_TYPES, NUM_AGENT_TYPES, heads, d, d)
        self.attention_matrix, self.message_matrix = nn.Parameter(same.clone()), nn.Parameter(same.clone())
        _zero_init(self.out)

    def forward(self, features: Tensor, key: Tensor, agent_type: Tensor) -> Tensor:
        """(N, C) of agents of kind (N,) that meet where key (N,) is the same, to (N, C)."""

        def split(x: Tensor) -> Tensor:
            return x.unflatten(1, (self.heads, -1))

        def to_both(x: Tensor, by_edge: Tensor) -> Tensor:
            """(N, heads, KINDS * d): rows x (N, heads, d) as queries of each kind are told of them."""
            return torch.einsum("nhd,qnhde->nhqe", x, by_edge[:, agent_type]).flatten(2)

        query = split(self.query(features, agent_type))
        one_hot = torch.nn.functional.one_hot(agent_type, NUM_AGENT_TYPES).to(query.dtype)
        # The wider head would be scaled by the root of its own width.
        query = (query[:, :, None] * one_hot[:, None, :, None]).flatten(2) * NUM_AGENT_TYPES**0.5
        keys = to_both(split(self.key(features, agent_type)), self.attention_matrix)
        messages = to_both(split(self.value(features, agent_type)), self.message_matrix)
        attended = window_attention(query, keys, messages, plan_windows(key, key)).unflatten(2, (NUM_AGENT_TYPES, -1))
        return self.out(
            attended[torch.arange(len(agent_type), device=agent_type.device), :, agent_type].flatten(1), agent_type
        )


class WindowScale(nn.Module):
    """Attention among one agent's tokens in windows of one size."""

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        self.qkv, self.out = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        _zero_init(self.out)

    def forward(self, features: Tensor, tokens: Tokens, agent: Tensor) -> Tensor:
        """(N, C) of agents (N,) to (N, C)."""
        cell, origin = tokens.grid.cell_size_m, (tokens.grid.x_min, tokens.grid.y_min)
        ids = window_ids(tokens.xy, agent, origin, self.window * cell)
        place = sincos_encoding(window_offsets(tokens.xy, origin, self.window * cell, cell), features.shape[1])
        # The place is told to queries and keys; values are what is there.
        weight, bias = self.qkv.weight, self.qkv.bias
        query, key, value = (
            torch.nn.functional.linear(x, w, b).unflatten(1, (self.heads, -1))
            for x, w, b in zip((features + place, features + place, features), weight.chunk(3), bias.chunk(3))
        )
        return self.out(window_attention(query, key, value, plan_windows(ids, ids)).flatten(1))


class MultiScaleWindows(nn.Module):
    """Windows half, once and twice as wide, more heads in the smaller, and how much each counts: split attention, a softmax a
    channel over the scales of what an agent's scales sum up to on average.
    """

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        shapes = (
            (config.heads * 2, config.window // 2),
            (config.heads, config.window),
            (config.heads // 2, config.window * 2),
        )
        self.scales = nn.ModuleList(WindowScale(channels, heads, window) for heads, window in shapes)
        self.inner, self.outer = nn.Linear(channels, channels), nn.Linear(channels, len(shapes) * channels)

    def forward(self, features: Tensor, tokens: Tokens, agent: Tensor, agents: int) -> Tensor:
        """(N, C) of agents (N,), so many, to (N, C)."""
        scales = torch.stack([scale(features, tokens, agent) for scale in self.scales], 1)
        count = segment_sum(scales.new_ones(len(agent), 1), agent, agents).clamp_min(1)
        mean = segment_sum(scales.sum(1), agent, agents) / count
        share = self.outer(torch.relu(self.inner(mean))).unflatten(1, (len(self.scales), -1)).softmax(1)
        return (share[agent] * scales).sum(1)


class V2xVitLayer(nn.Module):
    """One layer: between agents, over windows, and a feed-forward net; pre-norm, residual, and silent at the start."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.agent_attention, self.window_attention = (
            AgentAttention(channels, config.heads),
            MultiScaleWindows(channels, config),
        )
        hidden = channels * config.expansion
        last = nn.Linear(hidden, channels)
        self.ffn = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), last)
        _zero_init(last)

    def forward(self, features: Tensor, tokens: Tokens, key: Tensor, agent_type: Tensor) -> Tensor:
        """(N, C) to (N, C)."""
        between, within, alone = self.norms
        features = features + self.agent_attention(between(features), key, agent_type)
        agent = tokens.ego * NUM_AGENT_TYPES + agent_type
        features = features + self.window_attention(
            within(features), tokens, agent, tokens.batch_size * NUM_AGENT_TYPES
        )
        return features + self.ffn(alone(features))


class V2xVitFusion(nn.Module):
    """Layers of both attentions; then, as for every fusion here, tokens of a cell become one by trust."""

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        if config.heads % 2 or config.window % 2 or channels % (2 * config.heads):
            raise ConfigError(
                "V2xVitFusion needs even heads and window, and channels divisible by twice the heads; got "
                f"{config.heads}, {config.window} and {channels}."
            )
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "softmax")
        self.layers = nn.ModuleList(V2xVitLayer(channels, config) for _ in range(config.blocks))

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Tokens of all agents to one feature and one box a cell; the past is not looked at."""
        key, place = assign_cells(tokens)
        features, agent_type = self.encoding(tokens.features, tokens, place), agent_types(tokens)
        for layer in self.layers:
            features = layer(features, tokens, key, agent_type)
        return self.merge(features, tokens, key, place)


def agent_types(tokens: Tokens) -> Tensor:
    """(N,) int64: 0 the ego's own of now, whose cues are zero, 1 what was heard."""
    return tokens.pose_context.any(1).long()


def _zero_init(module: nn.Module) -> None:
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
