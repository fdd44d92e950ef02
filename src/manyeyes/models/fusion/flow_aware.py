# SPDX-License-Identifier: Apache-2.0
"""FAST, flow-aware fusion: self-attention over all agents' tokens, cross-attention to the ego's past, merge (CoSTr
III-D).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from manyeyes.models.detector.transformer import AttentionConfig, WindowTransformer
from manyeyes.models.fusion._past_attention_kernels import PastVectors, WindowTokens, attend_past
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens, are_last_rows, is_plain
from manyeyes.ops._attention_block_kernels import BlockMatrices, BlockWeights
from manyeyes.ops.window_attention import (
    plan_windows,
    sincos_encoding,
    window_attention,
    window_ids,
    window_offsets,
    window_places,
)


class PastAttention(nn.Module):
    """Pre-norm attention of tokens to past tokens in their window, and a feed-forward network; both residual and
    zero-initialised.

    A token whose window holds no past token is returned unchanged, so no softmax is taken over an empty set.
    """

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.heads, self.window = config.heads, config.window
        self.norm, self.norm_past, self.norm_ffn = (nn.LayerNorm(channels) for _ in range(3))
        self.query, self.key, self.value = (nn.Linear(channels, channels) for _ in range(3))
        self.out = nn.Linear(channels, channels, bias=False)
        hidden = channels * config.expansion
        last = nn.Linear(hidden, channels)
        self.ffn = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), last)
        for nothing in (self.out.weight, last.weight, last.bias):
            nn.init.zeros_(nothing)
        self.folded: PastWeights | None = None

    def fold(self, in_bfloat16: bool = False) -> None:
        """Copy the weights permanently to one compiled call; those of the layers are unused afterwards."""
        self.folded = PastWeights.of(self, in_bfloat16)

    def forward(self, features: Tensor, tokens: Tokens, past_features: Tensor, past: Tokens) -> Tensor:
        """Update features (N, C) of tokens by attention to past_features (M, C), both position-encoded; returns (N,
        C).
        """
        edge, cell = self.window * tokens.grid.cell_size_m, tokens.grid.cell_size_m
        origin = (tokens.grid.x_min, tokens.grid.y_min)
        if self.folded is not None and is_plain(features, past_features):
            here, there = (
                WindowTokens(
                    x.contiguous().numpy(), *(a.numpy() for a in window_places(t.xy, t.ego, origin, edge, cell))
                )
                for x, t in ((features, tokens), (past_features, past))
            )
            return self.folded.attend(here, there)
        query_window, past_window = (window_ids(t.xy, t.ego, origin, edge) for t in (tokens, past))
        plan = plan_windows(query_window, past_window)
        has_past = (plan.query_place < plan.query_slot.shape[0]).nonzero()[:, 0]
        if not len(has_past):
            return features
        normed, known = self.norm(features), self.norm_past(past_features)
        here, there = (
            sincos_encoding(window_offsets(t.xy, origin, edge, cell), features.shape[1]) for t in (tokens, past)
        )

        def split(x: Tensor) -> Tensor:
            return x.view(x.shape[0], self.heads, x.shape[1] // self.heads)

        heads = split(self.query(normed + here)), split(self.key(known + there)), split(self.value(known))
        some = (features + self.out(window_attention(*heads, plan).flatten(1)))[has_past]
        return features.index_copy(0, has_past, some + self.ffn(self.norm_ffn(some)))


@dataclass(frozen=True, eq=False)
class PastWeights:
    """Weights of a PastAttention for the compiled loops."""

    heads: int
    frequency: NDArray[np.float32]
    matrices: BlockMatrices
    vectors: PastVectors

    @classmethod
    def of(cls, layer: PastAttention, in_bfloat16: bool = False) -> PastWeights | None:
        """Return copies of the weights; None where the loops do not know such."""
        linears = [layer.query, layer.key, layer.value, layer.out, layer.ffn[0], layer.ffn[2]]
        norms = [layer.norm, layer.norm_past, layer.norm_ffn]
        block = BlockWeights.of(linears, norms[:2], layer.heads, in_bfloat16)
        if block is None:
            return None
        biased = [linear for linear in linears if linear is not layer.out]
        tensors = [*(w.bias for w in biased), *(t for n in norms for t in (n.weight, n.bias))]
        vectors = PastVectors(*(t.detach().float().contiguous().numpy().copy() for t in tensors))
        return cls(layer.heads, block.frequency, block.matrices, vectors)

    def attend(self, tokens: WindowTokens, past: WindowTokens) -> Tensor:
        """Return the features (N, C) of the tokens after attention to past ones."""
        return torch.from_numpy(attend_past(tokens, past, self.frequency, self.heads, self.matrices, self.vectors))


@register_fusion("fast")
class FastFusion(nn.Module):
    """Self-attention at the velocity-compensated positions, cross-attention to the ego's own past tokens, then
    TokenMerge.
    """

    def __init__(self, channels: int, config: AttentionConfig) -> None:
        super().__init__()
        self.encoding, self.transformer = SpatioTemporalEncoding(channels), WindowTransformer(channels, config)
        self.past_attention = PastAttention(channels, config)
        self.merge = TokenMerge(channels, "softmax")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents and the ego's past tokens to one feature and one box per cell."""
        key, place = assign_cells(tokens)
        placed = self.encoding(tokens.features, tokens, place)
        attended = self.transformer(placed, tokens.xy, tokens.ego, tokens.grid)
        if past is not None and len(past.features):
            if are_last_rows(past, tokens):
                past_features = placed[-len(past.features) :]
            else:
                past_features = self.encoding(past.features, past, assign_cells(past)[1])
            attended = self.past_attention(attended, tokens, past_features, past)
        return self.merge(attended, tokens, key, place)
