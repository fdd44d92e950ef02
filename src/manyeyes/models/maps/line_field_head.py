# SPDX-License-Identifier: Apache-2.0
"""A first sketch of a tile: what every cell says of the lines that run by it, and the lines that are followed from there.

The decoder's queries begin as these lines: the two stages of Deformable DETR (Zhu et al., ICLR 2021, section 4.2) with a proposal
that is a whole polyline. It learns from few tiles, since each cell of each tile teaches it, which a matched query does not; the
decoder has only to refine. Fields of nearest points and directions along lines are known from lane detection; walking them, and
dropping what lies on a line that is surer, is the plain way to lines.

A ring is sketched as the line along its middle with its half width, and proposed as the rectangle about that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from manyeyes.models.maps.image_encoder import conv_norm
from manyeyes.ops.line_tracing import TracingField, distance_to_lines, resample_evenly, trace_lines

MAX_LINE_OFFSET = 1.5
"""Cells from a line within which a cell knows where it runs."""
TRACE_STEP = 1.2
"""Cells a stride."""
DUPLICATE_DISTANCE = 1.25
"""Cells within which a place that lines are followed from lies on a line of its kind already."""
DUPLICATE_SCORE = 0.01
"""What a proposal is held for that lies on a surer one."""


@dataclass(frozen=True, eq=False)
class RawLineField:
    """What B tiles' cells say, kind by kind. line_logit: (B, K, rows, columns) logits that a line runs here; end_logit: likewise,
    that one ends here; offset_to_line: (B, K, 2, rows, columns) cells to its nearest point, x and y; direction: likewise, cosine
    and sine of twice its direction, not of length one; half_width: (B, K, rows, columns) cells, half the width of a ring.
    """

    line_logit: Tensor
    end_logit: Tensor
    offset_to_line: Tensor
    direction: Tensor
    half_width: Tensor


@dataclass(frozen=True, eq=False)
class LineProposals:
    """I lines a tile to begin with, the best first. point: (B, I, P, 2) shares of the tile; kind: (B, I) int64; score: (B, I), in
    (0, 1), how sure the cells were along it."""

    point: Tensor
    kind: Tensor
    score: Tensor


class LineFieldHead(nn.Module):
    """Two convolutions."""

    def __init__(self, channels: int, kinds: int) -> None:
        super().__init__()
        self.kinds = kinds
        self.inner = nn.Sequential(conv_norm(channels, channels, 3), nn.ReLU())
        self.out = nn.Conv2d(channels, 7 * kinds, 1)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            # Few cells have a line, or its end: each starts at a probability of 0.05.
            if self.out.bias is not None:
                self.out.bias.copy_(torch.where(torch.arange(7 * kinds) < 2 * kinds, -math.log(19), 0.0))

    def forward(self, ground: Tensor) -> RawLineField:
        """Features (B, C, rows, columns)."""
        k = self.kinds
        ink, end, half, foot, way = self.out(self.inner(ground)).split((k, k, k, 2 * k, 2 * k), 1)
        return RawLineField(ink, end, foot.unflatten(1, (k, 2)), way.unflatten(1, (k, 2)), half)


@torch.no_grad()
def propose_lines(
    line_field: RawLineField,
    ring_kinds: Tensor,
    count: int,
    num_points: int,
    num_seeds: int,
    min_score: float,
    duplicate_distance: float = DUPLICATE_DISTANCE,
) -> LineProposals:
    """The lines that the sketch shows, each once: from the surest cells, those that are followed farthest and surest come first.

    ring_kinds: (K,) bool, which kinds are rings. count: how many; where fewer are found, the rest are copies, held unsure.
    num_seeds: cells to follow lines from. min_score: how sure a cell is at least. duplicate_distance: 0 leaves copies as sure as
    they are.
    """
    b, kinds, rows, columns = line_field.line_logit.shape
    score = line_field.line_logit.sigmoid() * (-line_field.end_logit).sigmoid()
    peak = score == F.max_pool2d(score, 3, 1, 1)
    place = (score * torch.where(peak, 1.0, 1e-3)).flatten(1).topk(num_seeds).indices
    kind, cell = place // (rows * columns), place % (rows * columns)
    cell = torch.stack((cell // columns, cell % columns), -1)
    picture = torch.arange(b)[:, None] * kinds + kind
    strides = math.ceil((rows + columns) / TRACE_STEP)
    traced = trace_lines(
        _decode_field(line_field, score), picture.flatten(), cell.flatten(0, 1), min_score, TRACE_STEP, strides
    )
    line = resample_evenly(traced.points, num_points).unflatten(0, (b, num_seeds))
    half = line_field.half_width.flatten(1).gather(1, place).clamp_min(0.5)
    drawn = torch.where(
        ring_kinds[kind][..., None, None], outline_rectangles(line[:, :, 0], line[:, :, -1], half, num_points), line
    )
    total = traced.confidence.sum(1).unflatten(0, (b, num_seeds))
    mean = total / (traced.confidence > 0).sum(1).clamp_min(1).unflatten(0, (b, num_seeds))
    order = total.argsort(dim=1, descending=True, stable=True)
    start = traced.points[:, strides].unflatten(0, (b, num_seeds))
    on = (distance_to_lines(start, line) < duplicate_distance) & (kind[:, :, None] == kind[:, None])
    is_unique = suppress_duplicates(on, order)
    best = torch.where(is_unique, total, total - 4.0 * (rows + columns)).topk(count).indices
    point = drawn.gather(1, best[..., None, None].expand(-1, -1, num_points, 2)) / torch.tensor([columns, rows])
    held = torch.where(is_unique, mean, DUPLICATE_SCORE).gather(1, best).clamp(DUPLICATE_SCORE, 1 - DUPLICATE_SCORE)
    return LineProposals(point, kind.gather(1, best), held)


def outline_rectangles(first: Tensor, last: Tensor, half_width: Tensor, points: int) -> Tensor:
    """(..., P, 2) points, equally spaced, around rectangles: middle lines from first to last (..., 2), half widths half (...)."""
    axis = last - first
    length = axis.norm(dim=-1, keepdim=True)
    unit = torch.where(length > 1e-6, axis / length.clamp_min(1e-6), axis.new_tensor([1.0, 0.0]))
    side = torch.stack((-unit[..., 1], unit[..., 0]), -1) * half_width[..., None]
    corners = torch.stack((first - side, last - side, last + side, first + side, first - side), -2)
    return resample_evenly(corners, points + 1)[..., :-1, :]


def _decode_field(line_field: RawLineField, score: Tensor) -> TracingField:
    rows, columns = score.shape[-2:]
    row, column = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    foot = torch.stack((column, row)) + line_field.offset_to_line.clamp(-MAX_LINE_OFFSET, MAX_LINE_OFFSET)
    angle = torch.atan2(line_field.direction[:, :, 1], line_field.direction[:, :, 0]) / 2
    way = torch.stack((angle.cos(), angle.sin()), -1)
    return TracingField(score.flatten(0, 1), foot.permute(0, 1, 3, 4, 2).flatten(0, 1), way.flatten(0, 1))


def suppress_duplicates(overlaps: Tensor, order: Tensor) -> Tensor:
    """(B, N) bool: what no other drops. overlaps: (B, N, N), does row drop column? If it comes first in order (B, N), and is
    kept.
    """
    n = order.shape[1]
    ordered = overlaps.gather(1, order[..., None].expand(-1, -1, n)).gather(2, order[:, None].expand(-1, n, -1)).triu(1)
    dropped = torch.zeros_like(ordered[:, 0])
    for k in range(n):
        dropped = dropped | (ordered[:, k] & ~dropped[:, k : k + 1])
    return torch.ones_like(dropped).scatter(1, order, ~dropped)
