# SPDX-License-Identifier: Apache-2.0
"""A centre head on occupied cells: one box per cell, with predicted standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from manyeyes.datatypes import VEHICLE_LABELS, Boxes, Sites, SparseBev
from manyeyes.models.detector.layers import SubmanifoldLayer
from manyeyes.ops.nms import rotated_nms

TYPICAL_SIZE = (4.5, 1.9, 1.6)
SPEED_UNIT = 10.0
"""Metres per second in one unit of RawBoxes.velocity."""


class RawBoxLayout:
    """Columns of each quantity of RawBoxes in a row vector."""

    def __init__(self) -> None:
        ends = list(accumulate(WIDTHS, initial=0))
        spans = [slice(a, b) for a, b in pairwise(ends)]
        self.heatmap_logit, self.offset, self.z, self.log_size, self.axis, self.direction = spans[:6]
        self.class_logits, self.log_sigma_xy, self.log_sigma_yaw, self.iou_logit, self.velocity = spans[6:]
        self.total = ends[-1]


WIDTHS = (1, 2, 1, 3, 2, 2, len(VEHICLE_LABELS), 1, 1, 1, 2)
BOX_LAYOUT = RawBoxLayout()


@dataclass(frozen=True, eq=False)
class RawBoxes:
    """Head outputs at N sites, before decoding.

    Attributes:
        sites: the cells.
        heatmap_logit: (N,) logit that a box is centred here.
        offset: (N, 2) from the cell centre to the box centre, in cells.
        z: (N,) height of the box centre, metres.
        log_size: (N, 3) log(size / TYPICAL_SIZE).
        axis: (N, 2) cosine and sine of twice the yaw, the box axis modulo pi.
        direction: (N, 2) its dot product with a unit vector along the axis is the heading logit; it has no seam, as
            turning the vector by pi flips the sign.
        class_logits: (N, labels).
        log_sigma_xy: (N,) of metres.
        log_sigma_yaw: (N,) of radians.
        iou_logit: (N,) logit of the expected IoU of the box.
        velocity: (N, 2) over the ground, in SPEED_UNIT.
    """

    sites: Sites
    heatmap_logit: Tensor
    offset: Tensor
    z: Tensor
    log_size: Tensor
    axis: Tensor
    direction: Tensor
    class_logits: Tensor
    log_sigma_xy: Tensor
    log_sigma_yaw: Tensor
    iou_logit: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, rows: Tensor, sites: Sites) -> RawBoxes:
        """Split rows (N, BOX_LAYOUT.total) into the quantities."""
        heat, offset, z, log_size, axis, direction, kind, sigma_xy, sigma_yaw, overlap, velocity = rows.split(WIDTHS, 1)
        return cls(
            sites, heat[:, 0], offset, z[:, 0], log_size, axis, direction, kind,
            sigma_xy[:, 0], sigma_yaw[:, 0], overlap[:, 0], velocity,
        )  # fmt: skip

    def to_rows(self) -> Tensor:
        """Concatenate all quantities to rows (N, BOX_LAYOUT.total)."""
        values = (self.heatmap_logit, self.offset, self.z, self.log_size, self.axis, self.direction, self.class_logits)
        values = (*values, self.log_sigma_xy, self.log_sigma_yaw, self.iou_logit, self.velocity)
        return torch.cat([v[:, None] if v.dim() == 1 else v for v in values], 1)

    def bev(self) -> Tensor:
        """Return (N, 5) x, y, length, width, axis yaw of every site's box, differentiable."""
        xy = self.sites.xy + self.offset * self.sites.grid.cell_size_m
        size = self.log_size.new_tensor(TYPICAL_SIZE[:2]) * self.log_size[:, :2].clamp(-3, 3).exp()
        return torch.cat((xy, size, axis_yaw(self.axis)[:, None]), 1)

    def select(self, rows: Tensor) -> RawBoxes:
        """Select a subset of the sites by ascending rows (n,) int64."""
        sites = Sites(self.sites.key.index_select(0, rows), self.sites.grid, self.sites.batch_size)
        return RawBoxes.of(self.to_rows().index_select(0, rows), sites)

    def on(self, sites: Sites) -> RawBoxes:
        """Return the same outputs with an equal set of sites, on the device of that set."""
        return self if self.sites is sites else RawBoxes.of(self.to_rows().to(sites.key.device), sites)


def axis_yaw(axis: Tensor) -> Tensor:
    """Return yaw in (-pi/2, pi/2] of (N, 2) cosine and sine of twice the yaw."""
    return torch.atan2(axis[:, 1], axis[:, 0]) / 2


def heading_logit(raw: RawBoxes) -> Tensor:
    """Return the logit (N,) that the vehicle points along axis_yaw, not opposite to it; no gradient flows to the
    axis.
    """
    yaw = axis_yaw(raw.axis).detach()
    return raw.direction[:, 0] * yaw.cos() + raw.direction[:, 1] * yaw.sin()


def _trunk(inputs: int, channels: int) -> nn.Sequential:
    return nn.Sequential(
        SubmanifoldLayer(inputs, channels, norm=nn.LayerNorm), SubmanifoldLayer(channels, channels, norm=nn.LayerNorm)
    )


class BoxHead(nn.Module):
    """Two submanifold layers and one linear layer to all quantities of RawBoxes."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.shared = _trunk(inputs, channels)
        self.out = nn.Linear(channels, BOX_LAYOUT.total)
        nn.init.normal_(self.out.weight, std=0.02)
        nn.init.zeros_(self.out.bias)
        with torch.no_grad():
            self.out.bias[0] = -2.19

    def forward(self, x: SparseBev) -> RawBoxes:
        """Predict one raw box per site."""
        return RawBoxes.of(self.out(self.shared(x).features), x.sites)


class RefineHead(nn.Module):
    """A centre head that predicts residuals to given boxes; zero-initialised."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.shared = _trunk(inputs, channels)
        self.out = nn.Linear(channels, BOX_LAYOUT.total)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: SparseBev, proposals: Tensor) -> RawBoxes:
        """Refine proposals (N, BOX_LAYOUT.total) of the same sites."""
        return RawBoxes.of(proposals + self.out(self.shared(x).features), x.sites)


@dataclass(frozen=True)
class DecodeConfig:
    """Decoding of boxes: the score is heat^(1 - p) * IoU^p with p = iou_score_weight; nms_iou as in the evaluation
    protocol.
    """

    score_threshold: float = 0.05
    nms_iou: float = 0.15
    max_boxes: int = 200
    iou_score_weight: float = 0.4


def decode(raw: RawBoxes, config: DecodeConfig) -> list[Boxes]:
    """Decode the boxes of every grid of the batch, in the agent's frame, in descending order of score."""
    heatmap, iou = torch.sigmoid(raw.heatmap_logit.detach()), torch.sigmoid(raw.iou_logit.detach())
    score = heatmap ** (1 - config.iou_score_weight) * iou**config.iou_score_weight
    batch, found = raw.sites.batch, []
    for b in range(raw.sites.batch_size):
        rows = ((batch == b) & (score > config.score_threshold)).nonzero()[:, 0]
        rows = rows[score[rows].sort(descending=True, stable=True).indices]
        boxes = _boxes(raw, rows, score)
        found.append(boxes[rotated_nms(boxes.bev().double(), boxes.score, config.nms_iou)[: config.max_boxes]])
    return found


def _boxes(raw: RawBoxes, rows: Tensor, score: Tensor) -> Boxes:
    cell = raw.sites.grid.cell_size_m
    xy = raw.sites.xy[rows] + raw.offset[rows] * cell
    right = torch.sigmoid(heading_logit(raw))[rows]
    yaw = axis_yaw(raw.axis[rows]) + math.pi * (right < 0.5)
    return Boxes(
        center=torch.cat((xy, raw.z[rows, None]), 1).detach(),
        size=(raw.log_size.new_tensor(TYPICAL_SIZE) * raw.log_size[rows].clamp(-3, 3).exp()).detach(),
        yaw=torch.atan2(yaw.sin(), yaw.cos()).detach(),
        score=score[rows],
        label=raw.class_logits[rows].argmax(1),
        id=torch.full_like(rows, -1),
        sigma_xy=raw.log_sigma_xy[rows].exp().detach(),
        sigma_yaw=raw.log_sigma_yaw[rows].exp().detach(),
        p_flip=torch.minimum(right, 1 - right).detach(),
        velocity=raw.velocity[rows].detach() * SPEED_UNIT,
    )
