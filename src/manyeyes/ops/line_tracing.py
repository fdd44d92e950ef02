# SPDX-License-Identifier: Apache-2.0
"""Lines out of pictures of lines: walk along what each cell says of the line that runs by it, from many places at once.

A cell says how sure it is of a line, where the nearest point of that line lies, and which way it runs, of either sign. A walk takes
one stride along its heading, reads the cell that it comes to, steps sideways onto the line there, and turns to it; it ends half a
stride beyond the last cell that is sure, or before the line turns too sharply, or where the picture ends, or where it began. All
walks take as many strides, those that have ended stand still: no step depends on data, so that it can be exported. Coordinates
are cells: cell (row, column) spans x from column to column + 1, y from row to row + 1. Nothing here has gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import ShapeError

SHARPEST = 0.5
"""Cosine of the sharpest turn between two strides, 60 degrees."""
HOME = 4
"""Strides before a walk can have come home."""


@dataclass(frozen=True, eq=False)
class LineField:
    """M pictures of rows by columns cells. sure: (M, rows, columns). foot, way: (M, rows, columns, 2), x and y: the nearest point
    of the line, and a unit vector along it.
    """

    sure: Tensor
    foot: Tensor
    way: Tensor

    def __post_init__(self) -> None:
        if self.foot.shape != (*self.sure.shape, 2) or self.way.shape != self.foot.shape or self.sure.dim() != 3:
            raise ShapeError(
                f"LineField needs sure (M, rows, columns), foot and way (M, rows, columns, 2); got {tuple(self.sure.shape)}, "
                f"{tuple(self.foot.shape)} and {tuple(self.way.shape)}."
            )


@dataclass(frozen=True, eq=False)
class Walks:
    """W lines from end to end. points: (W, L, 2), repeated where a walk stood still. sure: (W, L), of the cell at each point, 0
    where it stood still.
    """

    points: Tensor
    sure: Tensor


def follow(field: LineField, picture: Tensor, cell: Tensor, least: float, stride: float, strides: int) -> Walks:
    """Walk both ways from cells (W, 2), row and column, of pictures (W,), at most so many strides each; L = 2 strides + 1."""
    rows, columns = field.sure.shape[1:]
    table = torch.cat((field.sure[..., None], field.foot, field.way), -1).flatten(0, 2)
    here = table[(picture * rows + cell[:, 0]) * columns + cell[:, 1]]
    sure, start, way = here[:, 0], here[:, 1:3], here[:, 3:5]
    walk = _Walk(table, picture, torch.tensor([columns, rows]), least, stride, strides)
    ahead, sure_ahead, closed = walk.go(start, way, sure >= least)
    back, sure_back, _ = walk.go(start, -way, (sure >= least) & ~closed)
    points = torch.cat((back.flip(1), start[:, None], ahead), 1)
    return Walks(points, torch.cat((sure_back.flip(1), sure[:, None], sure_ahead), 1))


@dataclass(frozen=True, eq=False)
class _Walk:
    table: Tensor
    picture: Tensor
    size: Tensor
    least: float
    stride: float
    strides: int

    def go(self, start: Tensor, heading: Tensor, going: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (W, strides, 2), how sure (W, strides), and who came home (W,)."""
        at, closed = start, torch.zeros_like(going)
        points, sures = [], []
        columns, rows = self.size.unbind()
        for stride in range(self.strides):
            to = at + self.stride * heading
            cell = to.floor().long()
            outside = ((cell < 0) | (cell >= self.size)).any(-1)
            cell = cell.clamp_min(0).minimum(self.size - 1)
            here = self.table[(self.picture * rows + cell[:, 1]) * columns + cell[:, 0]]
            way = here[:, 3:5]
            turn = (way * heading).sum(-1, keepdim=True)
            way = torch.where(turn < 0, -way, way)
            side = torch.stack((-way[:, 1], way[:, 0]), -1)
            onto = to + ((here[:, 1:3] - to) * side).sum(-1, keepdim=True) * side
            on = going & ~outside & (here[:, 0] >= self.least) & (turn[:, 0].abs() >= SHARPEST)
            # A line that leaves the picture is drawn to its border.
            last = torch.where(outside[:, None], to.clamp_min(0).minimum(self.size.to(to)), (at + to) / 2)
            at = torch.where(on[:, None], onto, torch.where(going[:, None], last, at))
            going = on
            heading = torch.where(going[:, None], way, heading)
            sures.append(here[:, 0] * going)
            if stride >= HOME:
                home = going & ((at - start).norm(dim=-1) < self.stride)
                at = torch.where(home[:, None], start, at)
                closed, going = closed | home, going & ~home
            points.append(at)
        return torch.stack(points, 1), torch.stack(sures, 1), closed


def evenly_along(lines: Tensor, count: int) -> Tensor:
    """(..., count, 2) points of equal arc length on lines (..., L, 2), both ends among them; repeated points do not matter."""
    step = lines.diff(dim=-2).norm(dim=-1)
    along = torch.cat((torch.zeros_like(step[..., :1]), step.cumsum(-1)), -1)
    wanted = along[..., -1:] * torch.linspace(0, 1, count)
    after = torch.searchsorted(along, wanted, right=True).clamp(1, lines.shape[-2] - 1)
    before = after - 1
    gone = wanted - along.gather(-1, before)
    share = (gone / step.gather(-1, before).clamp_min(1e-9)).clamp(0, 1)[..., None]
    ends = [lines.gather(-2, place[..., None].expand(*place.shape, 2)) for place in (before, after)]
    return torch.lerp(ends[0], ends[1], share)


def away_from(places: Tensor, lines: Tensor) -> Tensor:
    """(B, N, M): how far each of places (B, M, 2) lies from each of lines (B, N, P, 2), along the shortest way."""
    nearest = places.new_full((*lines.shape[:2], places.shape[1]), torch.inf)
    # Edge by edge, since all edges at once would take P times the memory.
    for a, b in zip(lines[:, :, None, :-1].unbind(3), lines[:, :, None, 1:].unbind(3)):
        edge, gone = b - a, places[:, None] - a
        share = ((gone * edge).sum(-1) / edge.square().sum(-1).clamp_min(1e-9)).clamp(0, 1)
        nearest = nearest.minimum((gone - share[..., None] * edge).square().sum(-1))
    return nearest.sqrt()
