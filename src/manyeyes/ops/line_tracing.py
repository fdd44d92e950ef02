# SPDX-License-Identifier: Apache-2.0
"""Trace lines in a line field from many seeds at once.

A cell holds the confidence of a line, the nearest point on it, and its direction of either sign. A trace takes one stride along
its heading, reads the cell there, moves laterally onto the line, and takes its direction. It ends half a stride beyond the last
confident cell, before a turn that is too sharp, at the border, or where it began. All traces take as many strides, and those
that have ended stand still: no step depends on data, so that it can be exported. Coordinates are cells: cell (row, column) spans
x from column to column + 1, y from row to row + 1. Nothing here has gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import ShapeError

MIN_TURN_COSINE = 0.5
"""Cosine of the sharpest turn between two strides, 60 degrees."""
MIN_STRIDES_TO_CLOSE = 4
"""Strides before a walk can have come home."""


@dataclass(frozen=True, eq=False)
class TracingField:
    """M pictures of rows by columns cells. confidence: (M, rows, columns). nearest_point, direction: (M, rows, columns, 2), x and
    y: the nearest point of the line, and a unit vector along it.
    """

    confidence: Tensor
    nearest_point: Tensor
    direction: Tensor

    def __post_init__(self) -> None:
        if (
            self.nearest_point.shape != (*self.confidence.shape, 2)
            or self.direction.shape != self.nearest_point.shape
            or self.confidence.dim() != 3
        ):
            raise ShapeError(
                f"TracingField needs confidence (M, rows, columns), nearest_point and direction (M, rows, columns, 2); "
                f"got {tuple(self.confidence.shape)}, {tuple(self.nearest_point.shape)} and {tuple(self.direction.shape)}."
            )


@dataclass(frozen=True, eq=False)
class TracedLines:
    """W lines from end to end. points: (W, L, 2), repeated where a walk stood still. confidence: (W, L), of the cell at each point,
    0 where it stood still.
    """

    points: Tensor
    confidence: Tensor


def trace_lines(
    field: TracingField, image_index: Tensor, cell: Tensor, min_confidence: float, stride: float, max_strides: int
) -> TracedLines:
    """Trace both ways from cells (W, 2), row and column, of fields (W,), at most so many strides each; L = 2 strides + 1."""
    rows, columns = field.confidence.shape[1:]
    table = torch.cat((field.confidence[..., None], field.nearest_point, field.direction), -1).flatten(0, 2)
    here = table[(image_index * rows + cell[:, 0]) * columns + cell[:, 1]]
    confidence, start, direction = here[:, 0], here[:, 1:3], here[:, 3:5]
    tracer = _Tracer(
        table, image_index, torch.tensor([columns, rows], device=table.device), min_confidence, stride, max_strides
    )
    ahead, sure_ahead, closed = tracer.trace(start, direction, confidence >= min_confidence)
    back, sure_back, _ = tracer.trace(start, -direction, (confidence >= min_confidence) & ~closed)
    points = torch.cat((back.flip(1), start[:, None], ahead), 1)
    return TracedLines(points, torch.cat((sure_back.flip(1), confidence[:, None], sure_ahead), 1))


@dataclass(frozen=True, eq=False)
class _Tracer:
    table: Tensor
    image_index: Tensor
    size: Tensor
    min_confidence: float
    stride: float
    max_strides: int

    def trace(self, start: Tensor, heading: Tensor, going: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return points (W, strides, 2), their probabilities (W, strides), and which lines closed (W,)."""
        at, closed = start, torch.zeros_like(going)
        points, confidences = [], []
        columns, rows = self.size.unbind()
        for stride in range(self.max_strides):
            to = at + self.stride * heading
            cell = to.floor().long()
            outside = ((cell < 0) | (cell >= self.size)).any(-1)
            cell = cell.clamp_min(0).minimum(self.size - 1)
            here = self.table[(self.image_index * rows + cell[:, 1]) * columns + cell[:, 0]]
            direction = here[:, 3:5]
            turn = (direction * heading).sum(-1, keepdim=True)
            direction = torch.where(turn < 0, -direction, direction)
            side = torch.stack((-direction[:, 1], direction[:, 0]), -1)
            onto = to + ((here[:, 1:3] - to) * side).sum(-1, keepdim=True) * side
            on = going & ~outside & (here[:, 0] >= self.min_confidence) & (turn[:, 0].abs() >= MIN_TURN_COSINE)
            # A line that leaves the picture is drawn to its border.
            last = torch.where(outside[:, None], to.clamp_min(0).minimum(self.size.to(to)), (at + to) / 2)
            at = torch.where(on[:, None], onto, torch.where(going[:, None], last, at))
            going = on
            heading = torch.where(going[:, None], direction, heading)
            confidences.append(here[:, 0] * going)
            if stride >= MIN_STRIDES_TO_CLOSE:
                home = going & ((at - start).norm(dim=-1) < self.stride)
                at = torch.where(home[:, None], start, at)
                closed, going = closed | home, going & ~home
            points.append(at)
        return torch.stack(points, 1), torch.stack(confidences, 1), closed


def resample_evenly(lines: Tensor, count: int) -> Tensor:
    """Return (..., count, 2) points of equal arc length on lines (..., L, 2), both ends among them; repeated points do not
    matter.
    """
    step = lines.diff(dim=-2).norm(dim=-1)
    station = torch.cat((torch.zeros_like(step[..., :1]), step.cumsum(-1)), -1)
    wanted = station[..., -1:] * torch.linspace(0, 1, count, device=lines.device)
    after = torch.searchsorted(station, wanted, right=True).clamp(1, lines.shape[-2] - 1)
    before = after - 1
    gone = wanted - station.gather(-1, before)
    fraction = (gone / step.gather(-1, before).clamp_min(1e-9)).clamp(0, 1)[..., None]
    ends = [lines.gather(-2, place[..., None].expand(*place.shape, 2)) for place in (before, after)]
    return torch.lerp(ends[0], ends[1], fraction)


def distance_to_lines(points: Tensor, lines: Tensor) -> Tensor:
    """Return (B, N, M): how far each of places (B, M, 2) lies from each of lines (B, N, P, 2), along the shortest way."""
    nearest = points.new_full((*lines.shape[:2], points.shape[1]), torch.inf)
    # Edge by edge, since all edges at once would take P times the memory.
    for a, b in zip(lines[:, :, None, :-1].unbind(3), lines[:, :, None, 1:].unbind(3)):
        edge, gone = b - a, points[:, None] - a
        fraction = ((gone * edge).sum(-1) / edge.square().sum(-1).clamp_min(1e-9)).clamp(0, 1)
        nearest = nearest.minimum((gone - fraction[..., None] * edge).square().sum(-1))
    return nearest.sqrt()
