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

from manyeyes.models.maps.image_encoder import conv
from manyeyes.ops.line_tracing import LineField, away_from, evenly_along, follow

REACH = 1.5
"""Cells from a line within which a cell knows where it runs."""
STRIDE = 1.2
"""Cells a stride."""
APART = 1.25
"""Cells within which a place that lines are followed from lies on a line of its kind already."""
UNSURE = 0.01
"""What a proposal is held for that lies on a surer one."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """What B tiles' cells say, kind by kind. ink: (B, K, rows, columns) logits that a line runs here; end: likewise, that one ends
    here; foot: (B, K, 2, rows, columns) cells to its nearest point, x and y; way: likewise, cosine and sine of twice its direction,
    not of length one; half: (B, K, rows, columns) cells, half the width of a ring.
    """

    ink: Tensor
    end: Tensor
    foot: Tensor
    way: Tensor
    half: Tensor


@dataclass(frozen=True, eq=False)
class Proposals:
    """I lines a tile to begin with, the best first. point: (B, I, P, 2) shares of the tile; kind: (B, I) int64; sure: (B, I), in
    (0, 1), how sure the cells were along it."""

    point: Tensor
    kind: Tensor
    sure: Tensor


class SketchHead(nn.Module):
    """Two convolutions."""

    def __init__(self, channels: int, kinds: int) -> None:
        super().__init__()
        self.kinds = kinds
        self.inner = nn.Sequential(conv(channels, channels, 3), nn.ReLU())
        self.out = nn.Conv2d(channels, 7 * kinds, 1)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            # Few cells have a line, or its end: each starts at a probability of 0.05.
            if self.out.bias is not None:
                self.out.bias.copy_(torch.where(torch.arange(7 * kinds) < 2 * kinds, -math.log(19), 0.0))

    def forward(self, ground: Tensor) -> Sketch:
        """Features (B, C, rows, columns)."""
        k = self.kinds
        ink, end, half, foot, way = self.out(self.inner(ground)).split((k, k, k, 2 * k, 2 * k), 1)
        return Sketch(ink, end, foot.unflatten(1, (k, 2)), way.unflatten(1, (k, 2)), half)


@torch.no_grad()
def propose(
    sketch: Sketch, rings: Tensor, count: int, points: int, seeds: int, least: float, apart: float = APART
) -> Proposals:
    """The lines that the sketch shows, each once: from the surest cells, those that are followed farthest and surest come first.

    rings: (K,) bool, which kinds are rings. count: how many; where fewer are found, the rest are copies, held unsure. seeds: cells
    to follow lines from. least: how sure a cell is at least. apart: 0 leaves copies as sure as they are.
    """
    b, kinds, rows, columns = sketch.ink.shape
    sure = sketch.ink.sigmoid() * (-sketch.end).sigmoid()
    peak = sure == F.max_pool2d(sure, 3, 1, 1)
    place = (sure * torch.where(peak, 1.0, 1e-3)).flatten(1).topk(seeds).indices
    kind, cell = place // (rows * columns), place % (rows * columns)
    cell = torch.stack((cell // columns, cell % columns), -1)
    picture = torch.arange(b)[:, None] * kinds + kind
    strides = math.ceil((rows + columns) / STRIDE)
    walks = follow(_field(sketch, sure), picture.flatten(), cell.flatten(0, 1), least, STRIDE, strides)
    line = evenly_along(walks.points, points).unflatten(0, (b, seeds))
    half = sketch.half.flatten(1).gather(1, place).clamp_min(0.5)
    drawn = torch.where(rings[kind][..., None, None], around(line[:, :, 0], line[:, :, -1], half, points), line)
    total = walks.sure.sum(1).unflatten(0, (b, seeds))
    mean = total / (walks.sure > 0).sum(1).clamp_min(1).unflatten(0, (b, seeds))
    order = total.argsort(dim=1, descending=True, stable=True)
    start = walks.points[:, strides].unflatten(0, (b, seeds))
    on = (away_from(start, line) < apart) & (kind[:, :, None] == kind[:, None])
    own = kept_once(on, order)
    best = torch.where(own, total, total - 4.0 * (rows + columns)).topk(count).indices
    point = drawn.gather(1, best[..., None, None].expand(-1, -1, points, 2)) / torch.tensor([columns, rows])
    held = torch.where(own, mean, UNSURE).gather(1, best).clamp(UNSURE, 1 - UNSURE)
    return Proposals(point, kind.gather(1, best), held)


def around(first: Tensor, last: Tensor, half: Tensor, points: int) -> Tensor:
    """(..., P, 2) points, equally spaced, around rectangles: middle lines from first to last (..., 2), half widths half (...)."""
    along = last - first
    length = along.norm(dim=-1, keepdim=True)
    unit = torch.where(length > 1e-6, along / length.clamp_min(1e-6), along.new_tensor([1.0, 0.0]))
    side = torch.stack((-unit[..., 1], unit[..., 0]), -1) * half[..., None]
    corners = torch.stack((first - side, last - side, last + side, first + side, first - side), -2)
    return evenly_along(corners, points + 1)[..., :-1, :]


def _field(sketch: Sketch, sure: Tensor) -> LineField:
    rows, columns = sure.shape[-2:]
    row, column = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    foot = torch.stack((column, row)) + sketch.foot.clamp(-REACH, REACH)
    angle = torch.atan2(sketch.way[:, :, 1], sketch.way[:, :, 0]) / 2
    way = torch.stack((angle.cos(), angle.sin()), -1)
    return LineField(sure.flatten(0, 1), foot.permute(0, 1, 3, 4, 2).flatten(0, 1), way.flatten(0, 1))


def kept_once(on: Tensor, order: Tensor) -> Tensor:
    """(B, N) bool: what no other drops. on: (B, N, N), does row drop column? If it comes first in order (B, N), and is kept."""
    n = order.shape[1]
    ordered = on.gather(1, order[..., None].expand(-1, -1, n)).gather(2, order[:, None].expand(-1, n, -1)).triu(1)
    dropped = torch.zeros_like(ordered[:, 0])
    for k in range(n):
        dropped = dropped | (ordered[:, k] & ~dropped[:, k : k + 1])
    return torch.ones_like(dropped).scatter(1, order, ~dropped)
