# SPDX-License-Identifier: Apache-2.0
"""Learned matching of boxes under candidate poses: log-odds of pairs, and of the candidate that they support.

The vote (pose/voting.py) adds the evidence of a candidate's pairs as if they agreed by chance independently of each other, and
ignores the other boxes. Pairs in one lane or one row of bays are not independent. Under the right pose the boxes that only one
agent observes stand in the lanes of the others and overlap none of them. The network reads both: all boxes of both agents attend
to each other with what they have in common under the pose as bias, then the pairs attend to each other, biased by pairwise
geometric consistency (differences of distances, as in SC2-PCR, Chen et al. 2022, and GeoTransformer, Qin et al. 2022).

Inputs are boxes alone. All features are invariant to both agents' frames, to the order of boxes, and to which agent is the ego.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, LayerCount
from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint

FORMAT = "manyeyes-candidate-matcher-1"
NUM_COLUMNS = 9
"""Of a box: x, y (m), yaw (rad), length, width (m), score, sigma_xy (m), sigma_yaw (rad), p_flip."""
MASKED_LOGIT = -1e4
_X, _Y, _YAW, _LENGTH, _WIDTH, _SCORE, _SIGMA_XY, _SIGMA_YAW, _P_FLIP = range(NUM_COLUMNS)
_BOX_DIM, _CROSS_DIM, _PAIR_DIM, _RELATION_DIM, _CANDIDATE_DIM = 8, 14, 17, 12, 7


@dataclass(frozen=True)
class CandidateMatcherConfig:
    """Settings of the network.

    Attributes:
        width: channels of a box and of a pair.
        relation_width: channels of what two boxes, or two pairs, have in common.
        context_layers: attention between the boxes of both agents.
        pair_layers: attention among the pairs of a candidate.
        heads: of the attention.
    """

    width: ChannelCount = 64
    relation_width: ChannelCount = 32
    context_layers: LayerCount = 2
    pair_layers: LayerCount = 2
    heads: ChannelCount = 4

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ConfigError(
                f"CandidateMatcherConfig.width must be divisible by heads; got {self.width}, {self.heads}."
            )


@dataclass(frozen=True, eq=False)
class CandidateBatch:
    """K candidates in each of B scenes, padded.

    a: (B, N, 9), b: (B, M, 9) boxes of ego and other, each in its agent's frame, see NUM_COLUMNS; mask_a, mask_b: bool, false for
    padding. pose: (B, K, 3) ego_from_other. score: (B, K) log-likelihood ratios of the vote. pairs: (B, K, P, 2) rows, -1 for
    padding.
    """

    a: Tensor
    b: Tensor
    mask_a: Tensor
    mask_b: Tensor
    pose: Tensor
    score: Tensor
    pairs: Tensor

    def to(self, device: torch.device) -> CandidateBatch:
        """Return the same batch on a device."""
        return CandidateBatch(*(column.to(device) for column in vars(self).values()))


@dataclass(frozen=True, eq=False)
class CandidateOdds:
    """candidate: (B, K) log-odds of each candidate against "none is right"; pair: (B, K, P) log-odds that a pair is one object."""

    candidate: Tensor
    pair: Tensor


def _log1p(x: Tensor, unit: float | Tensor) -> Tensor:
    return torch.log1p(x.abs() / unit)


def _bump(x: Tensor, sigma: float) -> Tensor:
    return torch.exp(-((x / sigma) ** 2) / 2)


def _wrap_half_turn(angle: Tensor) -> Tensor:
    """Wrap to [-pi/2, pi/2)."""
    return torch.remainder(angle + math.pi / 2, math.pi) - math.pi / 2


def _move(boxes: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions (B, K, M, 2) and headings (B, K, M) of boxes (B, M, 9) in the ego's frame, by poses (B, K, 3)."""
    c, s = pose[..., None, 2].cos(), pose[..., None, 2].sin()
    x, y = boxes[:, None, :, _X], boxes[:, None, :, _Y]
    xy = torch.stack((c * x - s * y + pose[..., None, 0], s * x + c * y + pose[..., None, 1]), -1)
    return xy, boxes[:, None, :, _YAW] + pose[..., None, 2]


def _box_features(boxes: Tensor) -> Tensor:
    """Return (B, N, _BOX_DIM)."""
    columns = (
        (boxes[..., _LENGTH].clamp_min(0.1) / 4.5).log() * 3,
        (boxes[..., _WIDTH].clamp_min(0.1) / 1.85).log() * 5,
        boxes[..., _SCORE],
        (boxes[..., _SIGMA_XY].clamp_min(0.01) / 0.25).log(),
        (boxes[..., _SIGMA_YAW].clamp_min(1e-3) / 0.07).log(),
        boxes[..., _P_FLIP] * 5,
        boxes[..., :2].norm(dim=-1) / 40,
        torch.ones_like(boxes[..., _SCORE]),
    )
    return torch.stack(columns, -1)


def _cross_features(batch: CandidateBatch, moved: Tensor, yaw: Tensor, is_pair: Tensor) -> Tensor:
    """Return (B, K, N, M, _CROSS_DIM): boxes of the other agent relative to the ego's, in the mean of their axes."""
    delta = moved[:, :, None] - batch.a[:, None, :, None, :2]
    off = batch.a[:, None, :, None, _YAW] - yaw[:, :, None]
    turn = _wrap_half_turn(off)
    axis = batch.a[:, None, :, None, _YAW] - turn / 2
    c, s = axis.cos(), axis.sin()
    ahead, aside = c * delta[..., 0] + s * delta[..., 1], c * delta[..., 1] - s * delta[..., 0]
    length = (batch.a[:, None, :, None, _LENGTH] + batch.b[:, None, None, :, _LENGTH]) / 2
    parallel = _bump(turn, 0.15)
    columns = (
        _log1p(ahead, 2.0) / 2,
        _log1p(aside, 0.5) / 2,
        (aside.abs() / 10).clamp_max(3.0),
        (ahead.abs() / 40).clamp_max(3.0),
        _bump(aside, 0.35) * parallel,
        _bump(aside, 0.8) * parallel,
        _bump(aside.abs() - 3.5, 0.8) * parallel,
        parallel,
        off.cos(),
        (length - ahead.abs()).clamp(-3, 3) * _bump(aside, 1.5),
        _bump(ahead, 8.0),
        turn.sin().abs(),
        is_pair,
        _bump(ahead, 1.5) * _bump(aside, 1.5),
    )
    return torch.stack(columns, -1)


@dataclass(frozen=True, eq=False)
class _AlignedPairs:
    """Pairs under their candidate's pose. a, b: (B, K, P, 9) boxes; middle (B, K, P, 2) m and axis (B, K, P) rad in the ego's
    frame; residual (B, K, P, 2) m and turn (B, K, P) rad of the ego's against the other's; is_flipped: headings differ by pi.
    """

    a: Tensor
    b: Tensor
    middle: Tensor
    axis: Tensor
    residual: Tensor
    turn: Tensor
    is_flipped: Tensor


def _gather(values: Tensor, rows: Tensor) -> Tensor:
    """Return values (B, K, P, C) at rows (B, K, P) of (B, K, N, C) or (B, 1, N, C)."""
    wide = values.expand(-1, rows.shape[1], -1, -1)
    return wide.gather(2, rows[..., None].expand(-1, -1, -1, values.shape[-1]))


def _align(batch: CandidateBatch, moved: Tensor, yaw: Tensor) -> _AlignedPairs:
    rows_a, rows_b = batch.pairs.clamp_min(0).unbind(-1)
    a, b = _gather(batch.a[:, None], rows_a), _gather(batch.b[:, None], rows_b)
    place = _gather(torch.cat((moved, yaw[..., None]), -1), rows_b)
    own, off = a[..., :2], a[..., _YAW] - place[..., 2]
    turn = _wrap_half_turn(off)
    middle = (own + place[..., :2]) / 2
    return _AlignedPairs(
        a, b, middle, a[..., _YAW] - turn / 2, own - place[..., :2], turn, (off.cos() < 0).to(own.dtype)
    )


def _pair_features(pairs: _AlignedPairs, score: Tensor) -> Tensor:
    """Return (B, K, P, _PAIR_DIM)."""
    a, b = pairs.a, pairs.b
    c, s = pairs.axis.cos(), pairs.axis.sin()
    dx, dy = pairs.residual.unbind(-1)
    sigma = (a[..., _SIGMA_XY] ** 2 + b[..., _SIGMA_XY] ** 2).sqrt().clamp_min(0.02)
    sigma_yaw = (a[..., _SIGMA_YAW] ** 2 + b[..., _SIGMA_YAW] ** 2).sqrt().clamp_min(0.005)
    ranges = torch.stack([x[..., :2].norm(dim=-1) / 40 for x in (a, b)])
    length, width = ((a[..., k] + b[..., k]) / 2 for k in (_LENGTH, _WIDTH))
    columns = (
        _log1p(c * dx + s * dy, 0.3),
        _log1p(c * dy - s * dx, 0.2),
        _log1p(pairs.residual.norm(dim=-1), sigma),
        _log1p(pairs.turn, 0.07),
        _log1p(pairs.turn, sigma_yaw),
        pairs.is_flipped,
        _log1p(a[..., _LENGTH] - b[..., _LENGTH], 0.3),
        _log1p(a[..., _WIDTH] - b[..., _WIDTH], 0.12),
        (length.clamp_min(0.1) / 4.5).log() * 3,
        (width.clamp_min(0.1) / 1.85).log() * 5,
        (sigma / 0.35).log(),
        (sigma_yaw / 0.1).log(),
        torch.minimum(a[..., _SCORE], b[..., _SCORE]),
        torch.maximum(a[..., _SCORE], b[..., _SCORE]),
        ranges.amin(0),
        ranges.amax(0),
        score[..., None].expand_as(sigma) / 20,
    )
    return torch.stack(columns, -1)


def _pair_relations(pairs: _AlignedPairs) -> Tensor:
    """Return (B, K, P, P, _RELATION_DIM), the second pair relative to the first."""
    apart_a, apart_b = ((x[..., None, :, :2] - x[..., :, None, :2]).norm(dim=-1) for x in (pairs.a, pairs.b))
    delta = pairs.middle[..., None, :, :] - pairs.middle[..., :, None, :]
    c, s = pairs.axis.cos()[..., None], pairs.axis.sin()[..., None]
    ahead, aside = c * delta[..., 0] + s * delta[..., 1], c * delta[..., 1] - s * delta[..., 0]
    distance = delta.norm(dim=-1)
    between = 2 * (pairs.axis[..., None, :] - pairs.axis[..., :, None])
    misfit = (pairs.residual[..., None, :, :] - pairs.residual[..., :, None, :]).norm(dim=-1)
    length = (pairs.a[..., _LENGTH] + pairs.b[..., _LENGTH]) / 2
    columns = (
        _log1p(apart_a - apart_b, 0.35),
        _log1p(distance, 5.0),
        _log1p(ahead, 5.0),
        _log1p(aside, 0.5),
        _bump(aside, 1.4),
        _bump(distance, 6.0),
        between.cos(),
        between.sin().abs(),
        _log1p(misfit, 0.35),
        _log1p(pairs.turn[..., None, :] - pairs.turn[..., :, None], 0.1),
        _log1p(length[..., None, :] - length[..., :, None], 0.5),
        (distance < 0.1).to(distance.dtype),
    )
    return torch.stack(columns, -1)


def _feed_forward(width: int) -> nn.Sequential:
    return nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))


class RelationAttention(nn.Module):
    """Attention from one set to another, biased by relations, which are also added to the values."""

    def __init__(self, config: CandidateMatcherConfig) -> None:
        super().__init__()
        width, self.heads = config.width, config.heads
        self.norm, self.qkv, self.out = nn.LayerNorm(width), nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.bias = nn.Linear(config.relation_width, self.heads)
        self.message = nn.Linear(config.relation_width * self.heads, width)
        self.ffn = _feed_forward(width)

    def project(self, x: Tensor) -> list[Tensor]:
        """Return query, key and value (C, heads, N, width / heads) of a set (C, N, width)."""
        return [part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.qkv(self.norm(x)).chunk(3, -1)]

    def attend(self, x: Tensor, query: Tensor, key: Tensor, value: Tensor, relations: Tensor, bias: Tensor) -> Tensor:
        """Update a set (C, N, width) by another with relations (C, N, M, relation_width) and masked bias (C, heads, N, M)."""
        attention = (query @ key.mT / query.shape[-1] ** 0.5 + bias).softmax(-1)
        related = (attention.transpose(1, 2) @ relations).flatten(2)
        x = x + self.out((attention @ value).transpose(1, 2).flatten(2)) + self.message(related)
        return x + self.ffn(x)

    def forward(self, x: Tensor, y: Tensor, relations: Tensor, mask_x: Tensor, mask_y: Tensor) -> tuple[Tensor, Tensor]:
        """Update two sets (C, N, width), (C, M, width) by each other; relations: (C, N, M, relation_width)."""
        (query_x, key_x, value_x), (query_y, key_y, value_y) = self.project(x), self.project(y)
        bias = self.bias(relations).permute(0, 3, 1, 2)
        to_x = bias.masked_fill(~mask_y[:, None, None], MASKED_LOGIT)
        to_y = bias.mT.masked_fill(~mask_x[:, None, None], MASKED_LOGIT)
        return (
            self.attend(x, query_x, key_y, value_y, relations, to_x),
            self.attend(y, query_y, key_x, value_x, relations.transpose(1, 2), to_y),
        )

    def forward_within(self, x: Tensor, relations: Tensor, mask: Tensor) -> Tensor:
        """Update one set (C, P, width) by itself; relations: (C, P, P, relation_width)."""
        bias = self.bias(relations).permute(0, 3, 1, 2).masked_fill(~mask[:, None, None], MASKED_LOGIT)
        return self.attend(x, *self.project(x), relations, bias)


class CandidateMatcher(nn.Module):
    """The network. Before training it repeats the vote: log-odds rise with the vote's score over its limit."""

    def __init__(self, config: CandidateMatcherConfig) -> None:
        super().__init__()
        self.config = config
        width, between = config.width, config.relation_width
        self.embed_box, self.sum_related = nn.Linear(_BOX_DIM, width), nn.Linear(2 * between, width)
        self.relate_boxes = nn.Sequential(nn.Linear(_CROSS_DIM, between), nn.GELU(), nn.Linear(between, between))
        self.context = nn.ModuleList(RelationAttention(config) for _ in range(config.context_layers))
        self.embed_pair = nn.Sequential(nn.Linear(_PAIR_DIM, width), nn.GELU(), nn.Linear(width, width))
        self.context_of_pair = nn.Linear(width, width)
        self.relate_pairs = nn.Sequential(nn.Linear(_RELATION_DIM, between), nn.GELU(), nn.Linear(between, between))
        self.blocks = nn.ModuleList(RelationAttention(config) for _ in range(config.pair_layers))
        self.pair_head = nn.Linear(width, 1)
        self.box_head = nn.Linear(width, 1)
        self.head = nn.Sequential(nn.Linear(4 * width + _CANDIDATE_DIM, width), nn.GELU(), nn.Linear(width, 1))
        # Of the score, of the margin over the next candidate, of log numbers of compared boxes, and an offset.
        self.vote_weight = nn.Parameter(torch.tensor([0.3, 0.4, 1.0, 1.5]))
        self.pair_weight = nn.Parameter(torch.tensor([0.0]))
        for last in (self.box_head, self.head[-1]):
            nn.init.zeros_(last.weight)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(last.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, batch: CandidateBatch) -> CandidateOdds:
        """Return the log-odds of candidates and pairs; MASKED_LOGIT for padding."""
        shape = batch.score.shape
        moved, yaw = _move(batch.b, batch.pose)
        mask_a, mask_b = (m[:, None].expand(*shape, -1).flatten(0, 1) for m in (batch.mask_a, batch.mask_b))
        x, y = self._describe_boxes(batch, moved, yaw, mask_a, mask_b)
        mask = (batch.pairs[..., 0] >= 0).flatten(0, 1)
        rows_a, rows_b = (r.flatten(0, 1)[:, None] for r in batch.pairs.clamp_min(0).unbind(-1))
        pairs = _align(batch, moved, yaw)
        z = self.embed_pair(_pair_features(pairs, batch.score)).flatten(0, 1)
        z = z + self.context_of_pair(_gather(x[:, None], rows_a)[:, 0] + _gather(y[:, None], rows_b)[:, 0])
        relations = self.relate_pairs(_pair_relations(pairs)).flatten(0, 1)
        for block in self.blocks:
            z = block.forward_within(z, relations, mask)  # pyright: ignore[reportCallIssue]
        pair = self.pair_head(z)[..., 0]
        pooled = torch.cat((_pool(z, mask), (_sum(x, mask_a) + _sum(y, mask_b)) / 16, _counts(batch, mask)), -1)
        boxes = _sum(self.box_head(x), mask_a) + _sum(self.box_head(y), mask_b)
        learned = self.head(pooled) + boxes / 4 + self.pair_weight * _sum(pair[..., None], mask)
        of_score, of_margin, of_count, offset = self.vote_weight.unbind()
        compared = (batch.mask_a.sum(1).clamp_min(1) * batch.mask_b.sum(1).clamp_min(1)).to(batch.score.dtype)
        vote = of_score * batch.score + of_margin * _margins(batch.score) - of_count * compared.log()[:, None] - offset
        odds = vote + learned.view(shape)
        has_pairs = (batch.pairs[..., 0] >= 0).any(-1)
        return CandidateOdds(
            odds.masked_fill(~has_pairs, MASKED_LOGIT),
            pair.masked_fill(~mask, MASKED_LOGIT).unflatten(0, shape),
        )

    def _describe_boxes(
        self, batch: CandidateBatch, moved: Tensor, yaw: Tensor, mask_a: Tensor, mask_b: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the boxes of both agents in their context, (B K, N, width) and (B K, M, width)."""
        is_pair = mark_pairs(batch.pairs, batch.a.shape[1], batch.b.shape[1])
        related = self.relate_boxes(_cross_features(batch, moved, yaw, is_pair.to(yaw.dtype))).flatten(0, 1)
        kept = related * (mask_a[:, :, None] & mask_b[:, None])[..., None]
        count = len(kept) // len(batch.a)
        found = []
        for boxes, axis in ((batch.a, 2), (batch.b, 1)):
            alone = self.embed_box(_box_features(boxes))[:, None].expand(-1, count, -1, -1).flatten(0, 1)
            found.append(alone + self.sum_related(torch.cat((kept.sum(axis) / 8, kept.amax(axis)), -1)))
        x, y = found
        for block in self.context:
            x, y = block(x, y, related, mask_a, mask_b)
        return x, y


def mark_pairs(pairs: Tensor, num_a: int, num_b: int) -> Tensor:
    """Return (B, K, N, M) bool, which boxes are a pair, of rows (B, K, P, 2), -1 for padding."""
    marked = torch.zeros(*pairs.shape[:2], num_a * num_b + 1, dtype=torch.bool, device=pairs.device)
    index = torch.where(pairs[..., 0] >= 0, pairs[..., 0] * num_b + pairs[..., 1], num_a * num_b)
    return marked.scatter_(2, index, True)[..., :-1].unflatten(-1, (num_a, num_b))


def _sum(x: Tensor, mask: Tensor) -> Tensor:
    return (x * mask[..., None]).sum(1)


def _pool(z: Tensor, mask: Tensor) -> Tensor:
    """Return sum, mean and maximum (C, 3 width) of sets (C, P, width)."""
    total = _sum(z, mask)
    maximum = z.masked_fill(~mask[..., None], MASKED_LOGIT).amax(1).clamp_min(-1e3) * mask.any(1, keepdim=True)
    return torch.cat((total / 4, total / mask.sum(1, keepdim=True).clamp_min(1), maximum), -1)


def _margins(score: Tensor) -> Tensor:
    """Return (B, K): each score less the best other one."""
    best = score.topk(min(2, score.shape[1]), dim=1).values
    return score - torch.where(score == best[:, :1], best[:, -1:], best[:, :1])


def _counts(batch: CandidateBatch, mask: Tensor) -> Tensor:
    """Return (B K, _CANDIDATE_DIM): numbers of boxes and pairs, and the score against the other candidates."""
    counts = torch.stack((batch.mask_a.sum(1), batch.mask_b.sum(1)), 1).clamp_min(1).to(batch.score.dtype).log()
    num_pairs = mask.sum(1).clamp_min(1).to(batch.score.dtype).view(batch.score.shape)
    columns = (
        batch.score / 20,
        _margins(batch.score) / 10,
        batch.score / num_pairs / 5,
        num_pairs.log(),
        counts.amin(1, keepdim=True).expand_as(batch.score),
        counts.amax(1, keepdim=True).expand_as(batch.score),
        _log1p(batch.pose[..., :2].norm(dim=-1), 10.0),
    )
    return torch.stack(columns, -1).flatten(0, 1)


def load(path: Path) -> CandidateMatcher:
    """Load a network in evaluation mode."""
    return checkpoint.load_as(path, FORMAT, CandidateMatcherConfig, CandidateMatcher)
