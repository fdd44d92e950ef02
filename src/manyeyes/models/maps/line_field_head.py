# SPDX-License-Identifier: Apache-2.0
"""Predict a line field on a tile, offset and direction of the nearest line at every cell, and trace lines in it.

The lines initialise the decoder's queries: the two stages of Deformable DETR (Zhu et al., ICLR 2021, section 4.2) with whole
polylines as proposals. The field trains on few tiles, because every cell is supervised; the decoder only refines. Offset and
direction fields are known from lane detection; lines are traced along them, and those that overlap a higher-scored line are
suppressed.

A ring is represented by its middle line and half width, and proposed as the rectangle around that line.
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
"""Maximum distance from a line, in cells, at which a cell predicts its position."""
TRACE_STEP = 1.2
"""Step length of a trace, in cells."""
DUPLICATE_DISTANCE = 1.25
"""Distance in cells within which a seed belongs to a traced line of its class."""
DUPLICATE_SCORE = 0.01
"""Score assigned to a proposal that overlaps a higher-scored one."""


@dataclass(frozen=True, eq=False)
class RawLineField:
    """Predicted line fields of B tiles, for K classes.

    Attributes:
        line_logit: (B, K, rows, columns) logit that a line passes through the cell.
        end_logit: (B, K, rows, columns) logit that a line ends here.
        offset_to_line: (B, K, 2, rows, columns) offset to the nearest point of the line, x and y, in cells.
        direction: (B, K, 2, rows, columns) cosine and sine of twice the line's direction, not normalised.
        half_width: (B, K, rows, columns) half the width of a ring, in cells.
    """

    line_logit: Tensor
    end_logit: Tensor
    offset_to_line: Tensor
    direction: Tensor
    half_width: Tensor


@dataclass(frozen=True, eq=False)
class LineProposals:
    """I proposed lines per tile, in descending order of score.

    point: (B, I, P, 2) fractions of the tile. kind: (B, I) int64. score: (B, I), mean line probability along the
    trace.
    """

    point: Tensor
    kind: Tensor
    score: Tensor


class LineFieldHead(nn.Module):
    """A convolution block and a convolution to all quantities of RawLineField."""

    def __init__(self, channels: int, kinds: int) -> None:
        super().__init__()
        self.kinds = kinds
        self.inner = nn.Sequential(conv_norm(channels, channels, 3), nn.ReLU())
        self.out = nn.Conv2d(channels, 7 * kinds, 1)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            # Few cells have a line or an end: prior probability 0.05.
            if self.out.bias is not None:
                self.out.bias.copy_(torch.where(torch.arange(7 * kinds, device="cpu") < 2 * kinds, -math.log(19), 0.0))

    def forward(self, ground: Tensor) -> RawLineField:
        """Predict the line field of features (B, C, rows, columns)."""
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
    """Trace lines from the cells of highest probability and suppress duplicates.

    Args:
        line_field: predicted fields of B tiles.
        ring_kinds: (K,) bool, classes that are rings.
        count: number of proposals; missing ones are duplicates with low scores.
        num_points: points of a proposal.
        num_seeds: number of cells from which lines are traced.
        min_score: minimum line probability along a trace.
        duplicate_distance: of duplicates, in cells; 0 keeps their scores.
    """
    b, kinds, rows, columns = line_field.line_logit.shape
    score = line_field.line_logit.sigmoid() * (-line_field.end_logit).sigmoid()
    peak = score == F.max_pool2d(score, 3, 1, 1)
    place = (score * torch.where(peak, 1.0, 1e-3)).flatten(1).topk(num_seeds).indices
    kind, cell = place // (rows * columns), place % (rows * columns)
    cell = torch.stack((cell // columns, cell % columns), -1)
    picture = torch.arange(b, device=kind.device)[:, None] * kinds + kind
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
    point = drawn.gather(1, best[..., None, None].expand(-1, -1, num_points, 2)) / drawn.new_tensor([columns, rows])
    held = torch.where(is_unique, mean, DUPLICATE_SCORE).gather(1, best).clamp(DUPLICATE_SCORE, 1 - DUPLICATE_SCORE)
    return LineProposals(point, kind.gather(1, best), held)


def outline_rectangles(first: Tensor, last: Tensor, half_width: Tensor, points: int) -> Tensor:
    """Sample (..., P, 2) equally spaced points on rectangles with middle lines first to last (..., 2) and half_width
    (...).
    """
    axis = last - first
    length = axis.norm(dim=-1, keepdim=True)
    unit = torch.where(length > 1e-6, axis / length.clamp_min(1e-6), axis.new_tensor([1.0, 0.0]))
    side = torch.stack((-unit[..., 1], unit[..., 0]), -1) * half_width[..., None]
    corners = torch.stack((first - side, last - side, last + side, first + side, first - side), -2)
    return resample_evenly(corners, points + 1)[..., :-1, :]


def _decode_field(line_field: RawLineField, score: Tensor) -> TracingField:
    rows, columns = score.shape[-2:]
    places = (torch.arange(n, device=score.device) + 0.5 for n in (rows, columns))
    row, column = torch.meshgrid(*places, indexing="ij")
    foot = torch.stack((column, row)) + line_field.offset_to_line.clamp(-MAX_LINE_OFFSET, MAX_LINE_OFFSET)
    angle = torch.atan2(line_field.direction[:, :, 1], line_field.direction[:, :, 0]) / 2
    way = torch.stack((angle.cos(), angle.sin()), -1)
    return TracingField(score.flatten(0, 1), foot.permute(0, 1, 3, 4, 2).flatten(0, 1), way.flatten(0, 1))


def suppress_duplicates(overlaps: Tensor, order: Tensor) -> Tensor:
    """Greedy suppression: returns the mask (B, N) of kept rows; overlaps (B, N, N), order (B, N).

    A row suppresses a column that it overlaps if it precedes it in order and is kept itself.
    """
    n = order.shape[1]
    ordered = overlaps.gather(1, order[..., None].expand(-1, -1, n)).gather(2, order[:, None].expand(-1, n, -1)).triu(1)
    dropped = torch.zeros_like(ordered[:, 0])
    for k in range(n):
        dropped = dropped | (ordered[:, k] & ~dropped[:, k : k + 1])
    return torch.ones_like(dropped).scatter(1, order, ~dropped)
