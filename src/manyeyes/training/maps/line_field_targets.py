# SPDX-License-Identifier: Apache-2.0
"""Targets and loss of the line field of a tile.

Directions have no sign and are represented by cosine and sine of twice the angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes import BevGrid
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.models.maps.head import is_ring
from manyeyes.models.maps.line_field_head import MAX_LINE_OFFSET, RawLineField
from manyeyes.ops.polyline import headings, resample_spaced

Floats = NDArray[np.float64]

LINE_SIGMA = 0.6
"""Standard deviation of the line probability across a line, in cells."""
SAMPLE_SPACING = 0.25
"""Spacing of the sampled points of a line, in cells."""
MIN_NORMALISER = 20.0
"""Minimum normaliser of a class in a batch, in cells of lines or ends: one short line."""
OBSERVED_MARGIN_M = 4.0
"""Distance beyond the observed cells at which lines are still targets: gaps between beams, and occlusion by cars."""
END_RADIUS = 0.75
"""Distance from the end of a line, in cells, at which a cell is labelled as end; cuts at the tile border are no ends."""


@dataclass(frozen=True, eq=False)
class LineFieldTarget:
    """Line field of one tile's ground truth, for K classes.

    Attributes:
        line_prob: (K, rows, columns) in [0, 1].
        end_mask: (K, rows, columns) 0 or 1.
        near_line: (K, rows, columns) bool, within MAX_LINE_OFFSET of a line; elsewhere the following have no meaning.
        offset_to_line: (K, 2, rows, columns) as in RawLineField.
        direction: (K, 2, rows, columns) as in RawLineField.
        half_width: (K, rows, columns) as in RawLineField.
    """

    line_prob: Tensor
    end_mask: Tensor
    near_line: Tensor
    offset_to_line: Tensor
    direction: Tensor
    half_width: Tensor

    def to(self, device: torch.device) -> LineFieldTarget:
        """Return the same target on a device."""
        return LineFieldTarget(*(column.to(device) for column in vars(self).values()))

    def mask_unobserved(self, seen: Tensor) -> LineFieldTarget:
        """Remove lines outside the observed mask (rows, columns)."""
        return replace(
            self, line_prob=self.line_prob * seen, end_mask=self.end_mask * seen, near_line=self.near_line & seen
        )


def dilate_observed(seen: Tensor, tile: BevGrid) -> Tensor:
    """Dilate the observed mask (B, rows, columns) by OBSERVED_MARGIN_M along both axes."""
    reach = round(OBSERVED_MARGIN_M / tile.cell_size_m)
    return F.max_pool2d(seen[:, None].float(), 2 * reach + 1, 1, reach)[:, 0] > 0


def make_line_field_target(truth: MapElements, tile: BevGrid, kinds: Sequence[str]) -> LineFieldTarget:
    """Make the target of the elements of these kinds, in the tile's frame, metres."""
    rows, columns = tile.shape
    ink = torch.zeros(len(kinds), rows, columns, device="cpu")
    foot, way = (torch.zeros(len(kinds), 2, rows, columns, device="cpu") for _ in range(2))
    end, half = torch.zeros_like(ink), torch.zeros_like(ink)
    for layer, kind in enumerate(kinds):
        own = np.flatnonzero(truth.kind == KINDS.index(kind))
        if not len(own):
            continue
        lines = [(truth.polyline(row) - [tile.x_min, tile.y_min]) / tile.cell_size_m for row in own.tolist()]
        widths = np.zeros(len(own))
        if is_ring(kind):
            lines, widths = map(list, zip(*(fit_middle_line(ring) for ring in lines)))
        cell, near, angle, row = _nearest([np.asarray(line) for line in lines], rows, columns)
        away = near - (cell[:, ::-1] + 0.5)
        at = (layer, *torch.from_numpy(cell.T.copy()))
        ink[at] = torch.from_numpy(np.exp(-(away**2).sum(1) / (2 * LINE_SIGMA**2))).float()
        both = (layer, slice(None), *torch.from_numpy(cell.T.copy()))
        foot[both] = torch.from_numpy(away).float().T
        way[both] = torch.from_numpy(np.stack((np.cos(2 * angle), np.sin(2 * angle)))).float()
        half[at] = torch.from_numpy(np.asarray(widths)[row]).float()
        end[layer] = torch.from_numpy(_tips(lines, rows, columns))
    return LineFieldTarget(ink, end, ink > 0, foot, way, half)


def fit_middle_line(ring: Floats) -> tuple[Floats, float]:
    """Return the middle line (2, 2) of the rectangle around a ring (K, 2), along its longest edge, and its half
    width.
    """
    edges = np.roll(ring, -1, axis=0) - ring
    unit = edges[int(np.argmax(np.hypot(*edges.T)))]
    unit = unit / max(float(np.hypot(*unit)), 1e-9)
    axes = np.stack((unit, [-unit[1], unit[0]]))
    local = ring @ axes.T
    low, high = local.min(0), local.max(0)
    middle, size = (low + high) / 2, high - low
    long = int(size[1] > size[0])
    ends = np.stack((middle, middle))
    ends[:, long] = low[long], high[long]
    return ends @ axes, float(size[1 - long]) / 2


def _tips(lines: Sequence[Floats], rows: int, columns: int) -> NDArray[np.float32]:
    """Return (rows, columns), 1 within END_RADIUS of an end of a line in cells; rings and border cuts have no ends."""
    open_lines = [line for line in lines if np.hypot(*(line[0] - line[-1])) > 0.1]
    ends = np.array([end for line in open_lines for end in (line[0], line[-1])]).reshape(-1, 2)
    ends = ends[((ends > 0.5) & (ends < [columns - 0.5, rows - 0.5])).all(1)]
    x, y = np.arange(columns) + 0.5, np.arange(rows) + 0.5
    away = np.hypot(x - ends[:, 0, None, None], y[:, None] - ends[:, 1, None, None])
    return np.any(away <= END_RADIUS, axis=0, keepdims=True)[0].astype(np.float32)


def _nearest(
    lines: Sequence[Floats], rows: int, columns: int
) -> tuple[NDArray[np.int64], Floats, Floats, NDArray[np.int64]]:
    """Return cells (Q, 2), row and column, within MAX_LINE_OFFSET of lines in cells, with nearest point (Q, 2),
    heading and line.
    """
    first = np.concatenate(([0], np.cumsum([len(line) for line in lines])))
    points, first = resample_spaced(np.concatenate(lines), first, SAMPLE_SPACING)
    angle, line = headings(points, first), np.repeat(np.arange(len(lines)), np.diff(first))
    side = np.arange(-int(np.ceil(MAX_LINE_OFFSET)), int(np.ceil(MAX_LINE_OFFSET)) + 1)
    around = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    cell = (np.floor(points).astype(np.int64)[:, None] + around).reshape(-1, 2)
    owner = np.repeat(np.arange(len(points)), len(around))
    away = ((cell + 0.5 - points[owner]) ** 2).sum(1)
    kept = (away <= MAX_LINE_OFFSET**2) & ((cell >= 0) & (cell < [columns, rows])).all(1)
    cell, owner, away = cell[kept], owner[kept], away[kept]
    key = cell[:, 1] * columns + cell[:, 0]
    order = np.lexsort((away, key))
    begins = np.flatnonzero(np.diff(key[order], prepend=-1))
    best = order[begins]
    return cell[best][:, ::-1], points[owner[best]], angle[owner[best]], line[owner[best]]


def line_field_loss(line_field: RawLineField, targets: Sequence[LineFieldTarget]) -> Tensor:
    """Return the loss of a batch of tiles.

    Line and end probabilities: cross entropy per unit of ground truth and class, as crossings are few. Offset,
    direction and half width:
    absolute error, mean over cells near a line.
    """
    ink, end, near, foot, way, half = (
        torch.stack([getattr(target, name) for target in targets])
        for name in ("line_prob", "end_mask", "near_line", "offset_to_line", "direction", "half_width")
    )
    drawn, ended = _per_unit(line_field.line_logit, ink), _per_unit(line_field.end_logit, end)
    off = ((line_field.offset_to_line - foot).abs() + (line_field.direction - way).abs()).sum(2)
    wide = near & (half > 0)
    broad = ((line_field.half_width - half).abs() * wide).sum() / wide.sum().clamp_min(1)
    return drawn + 0.5 * ended + (off * near).sum() / near.sum().clamp_min(1) + 0.2 * broad


def _per_unit(logit: Tensor, share: Tensor) -> Tensor:
    """Cross entropy (B, K, rows, columns) per class, divided by max(sum of the target, MIN_NORMALISER); mean over
    classes.
    """
    each = F.binary_cross_entropy_with_logits(logit, share, reduction="none").sum((0, 2, 3))
    return (each / share.sum((0, 2, 3)).clamp_min(MIN_NORMALISER)).mean()
