# SPDX-License-Identifier: Apache-2.0
"""A centre head on occupied cells: one box per cell, with predicted standard deviations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes._jit import F32x1, F32x2
from manyeyes.datatypes import LABELS, VEHICLE_LABELS, VEHICLES, Boxes, ConfigError, Sites, SparseBev
from manyeyes.models.detector._decode_kernels import DecodedBoxes, DecodeLimits, RawColumns, decode_grid
from manyeyes.models.detector.layers import SubmanifoldLayer
from manyeyes.ops.nms import MAX_CANDIDATES, rotated_nms

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
_RAW_COLUMNS = RawColumns(
    BOX_LAYOUT.offset.start, BOX_LAYOUT.z.start, BOX_LAYOUT.log_size.start, BOX_LAYOUT.axis.start,
    BOX_LAYOUT.direction.start, BOX_LAYOUT.class_logits.start, BOX_LAYOUT.log_sigma_xy.start,
    BOX_LAYOUT.log_sigma_yaw.start, BOX_LAYOUT.iou_logit.start, BOX_LAYOUT.velocity.start,
    len(VEHICLE_LABELS), SPEED_UNIT, *TYPICAL_SIZE,
)  # fmt: skip


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
        class_heat: (N, classes) logits that an object of each class is centred here, of which heatmap_logit is the maximum; None of
            one class. A proposal does not hold it: fused features tell the class anew.
        classes: of ``datatypes.CLASSES``, in the order of class_heat.
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
    class_heat: Tensor | None = None
    classes: tuple[str, ...] = VEHICLES

    @classmethod
    def of(cls, rows: Tensor, sites: Sites, classes: tuple[str, ...] = VEHICLES) -> RawBoxes:
        """Split rows (N, BOX_LAYOUT.total) into the quantities, without the heat of each class."""
        heat, offset, z, log_size, axis, direction, kind, sigma_xy, sigma_yaw, overlap, velocity = rows.split(WIDTHS, 1)
        raw = cls(
            sites, heat[:, 0], offset, z[:, 0], log_size, axis, direction, kind,
            sigma_xy[:, 0], sigma_yaw[:, 0], overlap[:, 0], velocity, classes=classes,
        )  # fmt: skip
        # ``replace`` makes an object without it.
        vars(raw)["_rows"] = rows
        return raw

    def to_rows(self) -> Tensor:
        """Return all quantities as rows (N, BOX_LAYOUT.total); those that they were split from are not copied."""
        if "_rows" in vars(self):
            return vars(self)["_rows"]
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
        heat = None if self.class_heat is None else self.class_heat.index_select(0, rows)
        return replace(RawBoxes.of(self.to_rows().index_select(0, rows), sites), class_heat=heat, classes=self.classes)

    @classmethod
    def cat(cls, many: Sequence[RawBoxes]) -> RawBoxes:
        """Return outputs on one grid each as a batch of all their grids."""
        grid, keys, size = many[0].sites.grid, list[Tensor](), 0
        for one in many:
            keys.append(one.sites.key + size * math.prod(grid.shape))
            size += one.sites.batch_size
        raw = cls.of(torch.cat([one.to_rows() for one in many]), Sites(torch.cat(keys), grid, size))
        heats = [one.class_heat for one in many if one.class_heat is not None]
        return replace(raw, class_heat=torch.cat(heats) if heats else None, classes=many[0].classes)

    def on(self, sites: Sites) -> RawBoxes:
        """Return the same outputs with an equal set of sites, on the device of that set."""
        if self.sites is sites:
            return self
        device = sites.key.device
        heat = None if self.class_heat is None else self.class_heat.to(device)
        return replace(RawBoxes.of(self.to_rows().to(device), sites), class_heat=heat, classes=self.classes)


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


def check_classes(classes: Sequence[str]) -> tuple[str, ...]:
    """Return the classes of a head.

    Raises:
        ConfigError: there is none, one is listed twice, or one is unknown.
    """
    Boxes.empty().class_rows(classes)
    if not classes or len(set(classes)) < len(classes):
        raise ConfigError(f"A detector needs at least one class, each once; got {', '.join(classes) or 'none'}.")
    return tuple(classes)


def _num_columns(classes: Sequence[str]) -> int:
    """Return the number of outputs: one class needs no heat beside heatmap_logit."""
    return BOX_LAYOUT.total + (len(classes) if len(classes) > 1 else 0)


def _with_class_heat(rows: Tensor, class_heat: Tensor, sites: Sites, classes: tuple[str, ...]) -> RawBoxes:
    """Return raw boxes of rows (N, BOX_LAYOUT.total) whose heat is the maximum of class_heat (N, classes)."""
    raw = RawBoxes.of(rows, sites)
    return replace(raw, heatmap_logit=class_heat.amax(1), class_heat=class_heat, classes=classes)


class BoxHead(nn.Module):
    """Two submanifold layers and one linear layer to all quantities of RawBoxes, with one heat map per class."""

    def __init__(self, inputs: int, channels: int, classes: Sequence[str] = VEHICLES) -> None:
        super().__init__()
        self.classes = check_classes(classes)
        self.shared = _trunk(inputs, channels)
        self.out = nn.Linear(channels, _num_columns(classes))
        nn.init.normal_(self.out.weight, std=0.02)
        nn.init.zeros_(self.out.bias)
        with torch.no_grad():
            self.out.bias[0] = -2.19
            self.out.bias[BOX_LAYOUT.total :] = -2.19

    def forward(self, x: SparseBev) -> RawBoxes:
        """Predict one raw box per site."""
        rows = self.out(self.shared(x).features)
        if len(self.classes) == 1:
            return RawBoxes.of(rows, x.sites, self.classes)
        return _with_class_heat(rows[:, : BOX_LAYOUT.total], rows[:, BOX_LAYOUT.total :], x.sites, self.classes)


class RefineHead(nn.Module):
    """A centre head that predicts residuals to given boxes, and to their heat for each class; zero-initialised."""

    def __init__(self, inputs: int, channels: int, classes: Sequence[str] = VEHICLES) -> None:
        super().__init__()
        self.classes = check_classes(classes)
        self.shared = _trunk(inputs, channels)
        self.out = nn.Linear(channels, _num_columns(classes))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: SparseBev, proposals: Tensor) -> RawBoxes:
        """Refine proposals (N, BOX_LAYOUT.total) of the same sites."""
        residual = self.out(self.shared(x).features)
        if len(self.classes) == 1:
            return RawBoxes.of(proposals + residual, x.sites, self.classes)
        rows = proposals + residual[:, : BOX_LAYOUT.total]
        return _with_class_heat(rows, rows[:, :1] + residual[:, BOX_LAYOUT.total :], x.sites, self.classes)


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
    """Decode the boxes of every grid of the batch, in the agent's frame, in descending order of score.

    Boxes of one class suppress each other. Vehicles have the label of class_logits, people that of their class.
    """
    if raw.class_heat is None:
        found = _decode_class(raw, raw.heatmap_logit, config)
        return found if raw.classes == VEHICLES else [_relabel(boxes, raw.classes[0]) for boxes in found]
    by_class = [
        [_relabel(boxes, name) for boxes in _decode_class(raw, heat, config)]
        for name, heat in zip(raw.classes, raw.class_heat.unbind(1))
    ]
    together = [Boxes.cat(list(parts)) for parts in zip(*by_class)]
    order = [boxes.score.argsort(descending=True, stable=True)[: config.max_boxes] for boxes in together]
    return [boxes[rows] for boxes, rows in zip(together, order)]


def decode_rows(rows: Tensor, sites: Sites, config: DecodeConfig) -> DecodedBoxes:
    """Decode rows (N, BOX_LAYOUT.total) of one grid, on the CPU, as :func:`decode` does those of a head of one class, to arrays."""
    return decode_grid(*make_decode_arguments(rows, sites, config))


def make_decode_arguments(
    rows: Tensor, sites: Sites, config: DecodeConfig
) -> tuple[F32x2, F32x2, F32x1, float, RawColumns, DecodeLimits]:
    """Return the arguments of the compiled ``decode_grid`` for rows (N, BOX_LAYOUT.total) of one grid, on the CPU."""
    values, heat = rows.detach().float().contiguous().numpy(), BOX_LAYOUT.heatmap_logit.start
    xy, cell_m = np.ascontiguousarray(sites.xy.numpy()), float(sites.grid.cell_size_m)
    return values, xy, np.ascontiguousarray(values[:, heat]), cell_m, _RAW_COLUMNS, _make_limits(config)


def _make_limits(config: DecodeConfig) -> DecodeLimits:
    return DecodeLimits(
        config.score_threshold, config.nms_iou, config.max_boxes, config.iou_score_weight, MAX_CANDIDATES
    )


def _relabel(boxes: Boxes, name: str) -> Boxes:
    """Return boxes of a class with its label; those of vehicles have labels of their own."""
    return boxes if name in VEHICLES else replace(boxes, label=torch.full_like(boxes.label, LABELS.index(name)))


def _decode_class(raw: RawBoxes, heatmap_logit: Tensor, config: DecodeConfig) -> list[Boxes]:
    """Decode the boxes of every grid by a heat map (N,)."""
    if heatmap_logit.device.type != "cpu" or heatmap_logit.dtype != torch.float32:
        return _decode_by_tensors(raw, heatmap_logit, config)
    limits = _make_limits(config)
    columns = (raw.to_rows(), raw.sites.xy, heatmap_logit)
    rows, xy, heat = (column.detach().float().contiguous().numpy() for column in columns)
    batch, found = raw.sites.batch.numpy(), []
    for b in range(raw.sites.batch_size):
        some = slice(None) if raw.sites.batch_size == 1 else batch == b
        boxes = decode_grid(rows[some], xy[some], heat[some], float(raw.sites.grid.cell_size_m), _RAW_COLUMNS, limits)
        center, size, yaw, score, label, sigma_xy, sigma_yaw, p_flip, velocity = map(torch.from_numpy, boxes)
        ids = torch.full_like(label, -1)
        found.append(Boxes(center, size, yaw, score, label, ids, sigma_xy, sigma_yaw, p_flip, velocity))
    return found


def _decode_by_tensors(raw: RawBoxes, heatmap_logit: Tensor, config: DecodeConfig) -> list[Boxes]:
    """Do the same on any device."""
    heatmap, iou = torch.sigmoid(heatmap_logit.detach()), torch.sigmoid(raw.iou_logit.detach())
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
