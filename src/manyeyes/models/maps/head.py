# SPDX-License-Identifier: Apache-2.0
"""Decode map elements from the features of a tile: a fixed number of queries, each one element of a fixed number of
points.

Sources: MapTR (Liao et al., ICLR 2023): hierarchical queries as sums of instance and point embeddings, reference points refined
layer by layer. MapTRv2 (IJCV 2024): decoupled self-attention among and within instances, and a second group of queries for
one-to-many matching in training. Deformable DETR (ICLR 2021): deformable attention, and queries initialised with first-stage
proposals (section 4.2). DAB-DETR (ICLR 2022): each layer receives the current point positions. The two groups never attend to each
other; the same layers run on each.

Differences to MapTR, for small data sets and few steps: an element starts as a line of the predicted line field
(models/maps/line_field_head.py) with its class and score, and layers predict residuals. Positions enter every layer and the point
branches. Points move by fractions of the tile, not by logits, whose gradients vanish at the tile's border, where lines are cut. A
layer attends to the ground before it compares queries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, LayerCount, StageCount
from manyeyes.datatypes import BevGrid, ConfigError
from manyeyes.datatypes.map_element import CROSSING, KINDS, MapElements
from manyeyes.models.maps.line_field_head import DUPLICATE_DISTANCE, LineFieldHead, RawLineField, propose_lines
from manyeyes.ops.deformable import sample_weighted

QueryGroup = Literal["one", "many"]

MOVE_SCALE = 0.1
"""Point displacement of one output unit, as a fraction of the tile."""

_FREQUENCIES = math.pi * 2.0 ** torch.arange(8, device="cpu")


@dataclass(frozen=True)
class MapHeadConfig:
    """Settings of the map head.

    Attributes:
        kinds: names of the element classes.
        num_queries: queries of one-to-one matching.
        num_points: points of a query.
        num_one_to_many_queries: queries of one-to-many matching, in training only.
        num_learned_queries: those of num_queries that start as learned lines as in MapTR, not as lines of the line
            field.
        num_seeds: minimum number of cells from which lines are traced.
        min_trace_score: minimum line probability of a cell for a trace to continue.
        feedforward_channels: hidden width of the feed-forward networks.
        num_sampling_points: sampled positions per attention head, point and layer.
        max_elements: maximum number of decoded elements, over all classes.
        score_threshold: minimum score of a decoded element.
    """

    kinds: tuple[str, ...] = ("divider", "boundary", "crossing")
    num_queries: ChannelCount = 50
    num_points: int = 20
    num_one_to_many_queries: int = 0
    num_learned_queries: int = 0
    num_seeds: int = 160
    min_trace_score: float = 0.2
    channels: ChannelCount = 128
    feedforward_channels: ChannelCount = 256
    layers: LayerCount = 3
    heads: ChannelCount = 8
    num_sampling_points: StageCount = 4
    max_elements: int = 50
    score_threshold: float = 0.05

    def __post_init__(self) -> None:
        if (
            self.channels % self.heads
            or self.num_points < 2
            or min(self.num_queries, self.layers, self.num_sampling_points) < 1
        ):
            raise ConfigError(f"MapHeadConfig needs channels divisible by heads and two points or more; got {self}.")
        if not 0 <= self.num_learned_queries < self.num_queries:
            raise ConfigError(
                f"MapHeadConfig.num_learned_queries must be below num_queries ({self.num_queries}); got {self.num_learned_queries}."
            )
        if not self.kinds or not set(self.kinds) <= set(KINDS) or len(set(self.kinds)) != len(self.kinds):
            raise ConfigError(f"MapHeadConfig.kinds are some of {', '.join(KINDS)}; got {self.kinds}.")


@dataclass(frozen=True, eq=False)
class RawMap:
    """Output of one layer for B tiles: logit (B, I, kinds) and point (B, I, P, 2) as fractions of the tile."""

    logit: Tensor
    point: Tensor


class _SelfAttention(nn.Module):
    """Attention among the rows of each sequence; positions are added to queries and keys, not to values."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query_key, self.value = nn.Linear(channels, 2 * channels), nn.Linear(channels, channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, x: Tensor, place: Tensor) -> Tensor:
        """Map (..., L, C) to (..., L, C); place broadcasts to the input."""
        query, key = self.query_key(x + place).chunk(2, -1)
        query, key, value = (t.unflatten(-1, (self.heads, -1)).transpose(-2, -3) for t in (query, key, self.value(x)))
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(-2, -3).flatten(-2))


class DeformableAttention(nn.Module):
    """Deformable attention: each query samples at learned offsets from its reference point (Deformable DETR, Eq. 2)."""

    def __init__(self, channels: int, heads: int, num_points: int) -> None:
        super().__init__()
        self.heads, self.num_points = heads, num_points
        self.value, self.out = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.offset, self.weight = nn.Linear(channels, heads * num_points * 2), nn.Linear(channels, heads * num_points)
        # Heads start with offsets in as many directions, one cell farther per sampling point.
        angle = torch.arange(heads, device="cpu") * (2 * math.pi / heads)
        ring = torch.stack((angle.cos(), angle.sin()), -1)
        ring = ring / ring.abs().amax(-1, keepdim=True)
        steps = ring[:, None] * torch.arange(1, num_points + 1, device="cpu")[:, None]
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)
        with torch.no_grad():
            self.offset.bias.copy_(steps.flatten())

    def forward(self, query: Tensor, reference: Tensor, ground: Tensor) -> Tensor:
        """Attend from query (B, Q, C) at reference (B, Q, 2), fractions of the tile, to ground (B, rows, columns, C);
        (B, Q, C).
        """
        b, q, channels = query.shape
        rows, columns = ground.shape[1:3]
        values = self.value(ground).view(b, rows, columns, self.heads, channels // self.heads).permute(0, 3, 4, 1, 2)
        offset = self.offset(query).view(b, q, self.heads, self.num_points, 2)
        weight = self.weight(query).view(b, q, self.heads, self.num_points).softmax(-1)
        at = reference[:, :, None, None] + offset / offset.new_tensor([columns, rows])
        return self.out(sample_weighted(values, at, weight))


class MapDecoderLayer(nn.Module):
    """Deformable attention, attention within and among instances, feed-forward network; a norm after each.

    Deformable attention comes first, not third as in MapTR, where the first layer compares queries without image
    evidence.
    """

    def __init__(self, config: MapHeadConfig) -> None:
        super().__init__()
        c = config.channels
        self.instance_attention, self.point_attention = _SelfAttention(c, config.heads), _SelfAttention(c, config.heads)
        self.deformable_attention = DeformableAttention(c, config.heads, config.num_sampling_points)
        self.ffn = nn.Sequential(
            nn.Linear(c, config.feedforward_channels), nn.ReLU(), nn.Linear(config.feedforward_channels, c)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(c) for _ in range(4))

    def forward(self, x: Tensor, place: Tensor, reference: Tensor, ground: Tensor) -> Tensor:
        """Update x (B, I, P, C) with positions place (B, I, P, C), reference (B, I, P, 2) and ground (B, rows,
        columns, C).
        """
        attended = self.deformable_attention((x + place).flatten(1, 2), reference.flatten(1, 2), ground)
        x = self.norms[0](x + attended.view_as(x))
        x = self.norms[1](x + self.point_attention(x, place))
        mixed = self.instance_attention(x.transpose(1, 2), place.transpose(1, 2)).transpose(1, 2)
        x = self.norms[2](x + mixed)
        return self.norms[3](x + self.ffn(x))


class MapHead(nn.Module):
    """Line field, queries initialised with its lines, and decoder layers with class and point branches."""

    def __init__(self, config: MapHeadConfig) -> None:
        super().__init__()
        self.config = config
        c = config.channels
        self.line_field_head = LineFieldHead(c, len(config.kinds))
        self.class_embedding = nn.Parameter(torch.randn(len(config.kinds), 2 * c, device="cpu"))
        self.point_embedding = nn.Parameter(torch.randn(config.num_points, 2 * c, device="cpu"))
        if config.num_learned_queries:
            self.query_embedding = nn.Parameter(torch.randn(config.num_learned_queries, 2 * c, device="cpu"))
            self.start_points = nn.Parameter(make_start_lines(config.num_learned_queries, config.num_points))
        self.position_encoder = nn.Sequential(nn.Linear(4 * len(_FREQUENCIES), c), nn.ReLU(), nn.Linear(c, c))
        self.layers = nn.ModuleList(MapDecoderLayer(config) for _ in range(config.layers))
        self.class_branches = nn.ModuleList(_class_branch(c, len(config.kinds)) for _ in range(config.layers))
        self.point_branches = nn.ModuleList(_point_branch(c) for _ in range(config.layers))

    def forward(self, ground: Tensor, line_field: RawLineField, group: QueryGroup = "one") -> tuple[RawMap, ...]:
        """Decode features of B tiles (B, C, rows, columns) and their line field to one RawMap per layer, the last the
        best.

        Queries of group "one" start as distinct lines; those of group "many" start as all traced lines, duplicates
        included.
        """
        reference, logit, kind = self.init_queries(line_field, group)
        each = self.class_embedding[kind]
        if self.config.num_learned_queries and group == "one":
            each = torch.cat((each, self.query_embedding.expand(len(each), *self.query_embedding.shape)), 1)
        embedded, x = (each[:, :, None] + self.point_embedding).chunk(2, -1)
        ground = ground.permute(0, 2, 3, 1)
        out = []
        for layer, class_branch, point_branch in zip(self.layers, self.class_branches, self.point_branches):
            place = embedded + self.position_encoder(encode_position(reference))
            x = layer(x, place, reference, ground)
            # The remaining displacement depends on the current position, which x alone does not hold.
            point = reference + MOVE_SCALE * point_branch(x + place)
            out.append(RawMap(logit + class_branch(x.mean(2)), point))
            reference = point.detach()
        return tuple(out)

    def init_queries(self, line_field: RawLineField, group: QueryGroup = "one") -> tuple[Tensor, Tensor, Tensor]:
        """Return the initial points (B, I, P, 2), logits (B, I, kinds), and classes of the queries from the line
        field.

        Queries from the line field come first and carry no gradient.
        """
        config = self.config
        rings = torch.tensor([is_ring(kind) for kind in config.kinds], device=line_field.line_logit.device)
        count, apart = (
            (config.num_queries - config.num_learned_queries, DUPLICATE_DISTANCE)
            if group == "one"
            else (config.num_one_to_many_queries, 0.0)
        )
        found = propose_lines(
            line_field, rings, count, config.num_points, max(config.num_seeds, count), config.min_trace_score, apart
        )
        own = F.one_hot(found.kind, len(config.kinds)).to(found.score)
        # Prior probability 0.01 of the classes that the line field does not predict (focal loss, Lin et al. 2017).
        point, logit = found.point, own * (torch.logit(found.score) + math.log(99))[..., None] - math.log(99)
        if config.num_learned_queries and group == "one":
            point = torch.cat((point, self.start_points.expand(len(point), *self.start_points.shape)), 1)
            logit = torch.cat(
                (logit, logit.new_full((len(point), config.num_learned_queries, len(config.kinds)), -math.log(99))), 1
            )
        return point, logit, found.kind


def make_start_lines(count: int, points: int) -> Tensor:
    """Make (count, points, 2) straight lines spread over the tile, 0.3 of it long, in all directions.

    Centres and directions are a low-discrepancy additive recurrence in three dimensions (Roberts 2018).
    """
    ratio = torch.tensor(1.2207440846, device="cpu").double() ** -torch.arange(1, 4, device="cpu")
    x, y, way = ((0.5 + torch.arange(count, device="cpu")[:, None] * ratio) % 1).unbind(-1)
    unit = torch.stack(((math.pi * way).cos(), (math.pi * way).sin()), -1)
    middle = 0.1 + 0.8 * torch.stack((x, y), -1)
    along = torch.linspace(-0.15, 0.15, points, device="cpu")[:, None]
    return (middle[:, None] + along * unit[:, None]).clamp(0, 1).float()


def encode_position(place: Tensor) -> Tensor:
    """Encode positions (..., 2), fractions of the tile, as (..., 32) sines and cosines; wavelengths 2 to 1/64 of the
    tile.
    """
    phase = (place[..., None] * _FREQUENCIES.to(place)).flatten(-2)
    return torch.cat((phase.sin(), phase.cos()), -1)


def _class_branch(channels: int, kinds: int) -> nn.Sequential:
    last = nn.Linear(channels, kinds)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    hidden = [part for _ in range(2) for part in (nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU())]
    return nn.Sequential(*hidden, last)


def _point_branch(channels: int) -> nn.Sequential:
    last = nn.Linear(channels, 2)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU(), last)


def decode_elements(raw: RawMap, tile: BevGrid, config: MapHeadConfig) -> list[MapElements]:
    """Decode the elements of each tile, in its frame, metres, in descending order of score.

    A query may yield elements of two classes, as in MapTR.
    """
    score = raw.logit.detach().sigmoid()
    low = np.array([tile.x_min, tile.y_min])
    size = np.array([tile.x_max, tile.y_max]) - low
    code = np.array([KINDS.index(kind) for kind in config.kinds])
    out = []
    for scores, points in zip(score.cpu(), raw.point.detach().clamp(0, 1).double().cpu()):
        value, order = scores.flatten().sort(descending=True, stable=True)
        kept = order[: config.max_elements][value[: config.max_elements] >= config.score_threshold]
        query, kind = (kept // scores.shape[1]).numpy(), (kept % scores.shape[1]).numpy()
        lines = points.numpy()[query] * size + low
        out.append(MapElements.of(list(lines), code[kind], scores.flatten()[kept].double().numpy()))
    return out


def is_ring(kind: str) -> bool:
    """Return whether elements of this kind are closed rings."""
    return KINDS.index(kind) == CROSSING
