# SPDX-License-Identifier: Apache-2.0
"""Match the keypoints of two agents: stacked self- and cross-attention, and an assignment matrix.

FeaKM section 4.2.2 (Eq. 4, 5) with rotary position encoding (Su et al., RoFormer). The assignment is that of LightGlue
(Lindenberger et al. 2023), used unchanged by FeaKM's code: log P_ij is the row-wise plus the column-wise log softmax of the
similarity, plus the log sigmoid of both matchabilities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes._bounds import ChannelCount, LayerCount
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.pose.neighbour_geometry import NeighbourGeometryConfig, NeighbourGeometryEncoder

MASKED_LOGIT = -1e4
"""Logit of masked entries; finite, so that an empty set gives no NaN."""


@dataclass(frozen=True)
class MatcherConfig:
    """Settings of the matcher.

    Attributes:
        descriptor_dim: length of an input descriptor.
        width: channels of the attention blocks.
        layers: number of self- and cross-attention blocks.
        heads: of the attention.
        position_unit_m: unit of the positions.
        frequency_std: initial standard deviation of the rotary frequencies, radians per unit.
        min_match_prob: minimum probability of a match.
        neighbour_geometry: settings of the rotation-invariant neighbour encoding; None as published.
    """

    descriptor_dim: ChannelCount = 256
    width: ChannelCount = 256
    layers: LayerCount = 9
    heads: ChannelCount = 4
    position_unit_m: float = 100.0
    frequency_std: float = 1.0
    min_match_prob: float = 0.1
    neighbour_geometry: NeighbourGeometryConfig | None = None

    def __post_init__(self) -> None:
        if self.width % (4 * self.heads):
            raise ConfigError(f"MatcherConfig.width must be divisible by 4 * heads; got {self.width}, {self.heads}.")


@dataclass(frozen=True, eq=False)
class KeypointBatch:
    """Padded keypoints of B views.

    descriptor: (B, N, D). xy: (B, N, 2) m. yaw: (B, N). size: (B, N, 2) m. mask: (B, N) bool, false for padding.
    """

    descriptor: Tensor
    xy: Tensor
    yaw: Tensor
    size: Tensor
    mask: Tensor

    @classmethod
    def of(cls, keypoints: Sequence[Keypoints]) -> KeypointBatch:
        """Pad the keypoints of several views to the longest list."""

        def pad(values: Sequence[Tensor]) -> Tensor:
            return nn.utils.rnn.pad_sequence([v.float() for v in values], batch_first=True)

        return cls(
            pad([k.descriptor for k in keypoints]),
            pad([k.xy for k in keypoints]),
            pad([k.boxes.yaw for k in keypoints]),
            pad([k.boxes.size[:, :2] for k in keypoints]),
            pad([k.xy.new_ones(len(k)) for k in keypoints]).bool(),
        )

    def to(self, device: torch.device) -> KeypointBatch:
        """Return the same keypoints on a device."""
        return KeypointBatch(*(column.to(device) for column in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Assignment:
    """Log probabilities of matches log_p (B, N, M), and of no match log_unmatched_a (B, N), log_unmatched_b (B, M)."""

    log_p: Tensor
    log_unmatched_a: Tensor
    log_unmatched_b: Tensor


def find_mutual_matches(assignment: Assignment, min_prob: float) -> list[tuple[Tensor, Tensor]]:
    """Return, per pair of views, mutual best matches (P, 2) with a probability above min_prob, and these
    probabilities (P,).
    """
    found = []
    for log_p in assignment.log_p:
        if not log_p.numel():
            found.append((log_p.new_zeros(0, 2, dtype=torch.int64), log_p.new_zeros(0)))
            continue
        best, j = log_p.max(1)
        i = torch.arange(len(log_p), device=log_p.device)
        rows = (log_p.argmax(0)[j] == i) & (best.exp() > min_prob)
        found.append((torch.stack((i[rows], j[rows]), 1), best[rows].exp()))
    return found


class Matcher(nn.Module):
    """Layers of self- and cross-attention, each with its own assignment for deep supervision."""

    def __init__(self, config: MatcherConfig) -> None:
        super().__init__()
        self.config = config
        d, heads = config.width, config.heads
        self.input_projection = nn.Identity() if config.descriptor_dim == d else nn.Linear(config.descriptor_dim, d)
        self.neighbour_geometry = (
            None if config.neighbour_geometry is None else NeighbourGeometryEncoder(d, config.neighbour_geometry)
        )
        self.position_encoder = nn.Linear(2, d // heads // 2, bias=False)
        nn.init.normal_(self.position_encoder.weight, std=config.frequency_std)
        self.self_blocks = nn.ModuleList(SelfAttentionBlock(d, heads) for _ in range(config.layers))
        self.cross_blocks = nn.ModuleList(CrossAttentionBlock(d, heads) for _ in range(config.layers))
        self.assignment_heads = nn.ModuleList(AssignmentHead(d) for _ in range(config.layers))

    def forward(self, a: KeypointBatch, b: KeypointBatch) -> list[Assignment]:
        """Return the assignment of every layer; the last is the result, see find_mutual_matches."""
        (x, turn_x), (y, turn_y) = self._embed(a), self._embed(b)
        found = []
        for self_block, cross_block, assignment_head in zip(self.self_blocks, self.cross_blocks, self.assignment_heads):
            x, y = self_block(x, turn_x, a.mask), self_block(y, turn_y, b.mask)
            x, y = cross_block(x, y, a.mask, b.mask)
            found.append(assignment_head(x, y, a.mask, b.mask))
        return found

    def _embed(self, points: KeypointBatch) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        x = self.input_projection(points.descriptor)
        if self.neighbour_geometry is not None:
            x = x + self.neighbour_geometry(points.xy, points.yaw, points.size, points.mask)
        angle = self.position_encoder(points.xy / self.config.position_unit_m)[:, None]
        return x, (angle.cos(), angle.sin())


def apply_rotary(x: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
    """Rotate channel pairs of (B, heads, N, c) by angles given as cosine and sine (B, 1, N, c / 2).

    The product of two rotated vectors depends on the difference of their positions only (RoFormer, Eq. 14).
    """
    c, s = turn
    u, v = x[..., 0::2], x[..., 1::2]
    return torch.stack((u * c - v * s, u * s + v * c), -1).flatten(-2)


def _make_ffn(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), nn.Linear(2 * width, width)
    )


def _split(x: Tensor, heads: int) -> Tensor:
    """Split (B, N, d) to (B, heads, N, d / heads)."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def _bias(mask: Tensor) -> Tensor:
    """Return the additive attention mask (B, 1, 1, N)."""
    return (~mask).float()[:, None, None] * MASKED_LOGIT


class SelfAttentionBlock(nn.Module):
    """Self-attention among the keypoints of one view, by content and relative position."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.out, self.ffn = nn.Linear(width, 3 * width), nn.Linear(width, width), _make_ffn(width)

    def forward(self, x: Tensor, turn: tuple[Tensor, Tensor], mask: Tensor) -> Tensor:
        """Map (B, N, d) to (B, N, d)."""
        q, k, v = (_split(part, self.heads) for part in self.qkv(x).chunk(3, -1))
        attended = functional.scaled_dot_product_attention(apply_rotary(q, turn), apply_rotary(k, turn), v, _bias(mask))
        return x + self.ffn(torch.cat((x, self.out(attended.transpose(1, 2).flatten(-2))), -1))


class CrossAttentionBlock(nn.Module):
    """Cross-attention between two views by content; one projection serves as query and key of both."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(3))
        self.ffn = _make_ffn(width)

    def forward(self, x: Tensor, y: Tensor, mask_x: Tensor, mask_y: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, N, d) and (B, M, d) to the same shapes."""
        key_x, key_y = (_split(self.key(z), self.heads) for z in (x, y))
        value_x, value_y = (_split(self.value(z), self.heads) for z in (x, y))
        to_x = functional.scaled_dot_product_attention(key_x, key_y, value_y, _bias(mask_y))
        to_y = functional.scaled_dot_product_attention(key_y, key_x, value_x, _bias(mask_x))
        return self._add(x, to_x), self._add(y, to_y)

    def _add(self, x: Tensor, attended: Tensor) -> Tensor:
        return x + self.ffn(torch.cat((x, self.out(attended.transpose(1, 2).flatten(-2))), -1))


class AssignmentHead(nn.Module):
    """Similarity of two sets of keypoints and the matchability of each keypoint, as one assignment matrix."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project, self.matchable = nn.Linear(width, width), nn.Linear(width, 1)

    def forward(self, x: Tensor, y: Tensor, mask_x: Tensor, mask_y: Tensor) -> Assignment:
        """Map (B, N, d) and (B, M, d) to an assignment (B, N, M)."""
        similar = self.project(x) @ self.project(y).mT / x.shape[-1] ** 0.5
        z_x, z_y = self.matchable(x)[..., 0], self.matchable(y)[..., 0]
        by_row = similar.masked_fill(~mask_y[:, None], MASKED_LOGIT).log_softmax(2)
        by_column = similar.masked_fill(~mask_x[:, :, None], MASKED_LOGIT).log_softmax(1)
        log_p = by_row + by_column + functional.logsigmoid(z_x)[:, :, None] + functional.logsigmoid(z_y)[:, None]
        log_p = log_p.masked_fill(~(mask_x[:, :, None] & mask_y[:, None]), MASKED_LOGIT)
        return Assignment(log_p, functional.logsigmoid(-z_x), functional.logsigmoid(-z_y))
