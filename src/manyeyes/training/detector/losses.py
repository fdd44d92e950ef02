# SPDX-License-Identifier: Apache-2.0
"""Losses of the centre head, of focal pruning, and of the predicted standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import VEHICLE_LABELS, VEHICLES, Boxes
from manyeyes.models.detector.box_head import SPEED_UNIT, TYPICAL_SIZE, RawBoxes, axis_yaw, heading_logit
from manyeyes.models.detector.pruning import PruneOutput
from manyeyes.ops.box_iou import aligned_iou
from manyeyes.training.detector.mutual_information import InformationTarget
from manyeyes.training.detector.targets import Targets

MAX_CELL_WEIGHT = 8.0
"""Maximum weight of a cell relative to the mean, so that an object of one cell does not dominate a batch."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms.

    Attributes:
        heat: centre heatmap.
        shape: offsets, height, size and axis.
        direction: heading along the axis.
        classification: object class.
        sigma: likelihood of the predicted standard deviations.
        iou_score: predicted IoU.
        iou: 1 - IoU, for boxes that already overlap; 0 at the start of training.
        velocity: of the object.
        prune: focal pruning.
        mask_l1: L1 norm of the selector's mask (CoSTr Eq. 12).
        information: InfoNCE of the selector (CoSTr Eq. 12).
        fusion_weight: fraction of the fused boxes' loss; the rest is that of single-agent boxes.
        target: reference of the mutual information; other values than own_task are for studies.
        distillation: of the fused features from a teacher on merged clouds (DiscoNet); the teacher has the initial weights.
    """

    heat: float = 1.0
    shape: float = 0.5
    direction: float = 0.3
    classification: float = 0.1
    sigma: float = 0.05
    iou_score: float = 0.3
    iou: float = 0.0
    velocity: float = 1.0
    prune: float = 0.2
    mask_l1: float = 0.02
    information: float = 0.01
    fusion_weight: float = 0.5
    target: InformationTarget = "own_task"
    distillation: float = 0.0


@dataclass(frozen=True)
class LossTerms:
    """Unweighted loss terms of one batch, as scalars; fields as in LossConfig. distillation: None without a teacher."""

    heat: Tensor
    shape: Tensor
    direction: Tensor
    classification: Tensor
    sigma: Tensor
    iou_score: Tensor
    iou: Tensor
    velocity: Tensor
    prune: Tensor
    mask_l1: Tensor
    information: Tensor
    distillation: Tensor | None = None

    def mix(self, other: LossTerms, share: float) -> LossTerms:
        """Interpolate linearly: this fraction of the other terms, the rest of these."""
        theirs = other.computed()
        mixed = {name: (1 - share) * mine + share * theirs[name] for name, mine in self.computed().items()}
        return LossTerms(**mixed)

    def computed(self) -> dict[str, Tensor]:
        """Return the terms that there are, by name."""
        return {f.name: term for f in fields(self) if (term := getattr(self, f.name)) is not None}

    def total(self, config: LossConfig) -> Tensor:
        """Return the weighted sum of all terms."""
        return torch.stack([term * getattr(config, name) for name, term in self.computed().items()]).sum()


def centre_focal(logit: Tensor, heat: Tensor, positive: Tensor) -> Tensor:
    """CornerNet's penalty-reduced focal loss (alpha 2, beta 4) over sites, divided by max(1, number of positives)."""
    p = torch.sigmoid(logit).clamp(1e-4, 1 - 1e-4)
    gain = (1 - p) ** 2 * p.log()
    rest = (1 - heat) ** 4 * p**2 * (1 - p).log()
    return -torch.where(positive, gain, rest).sum() / positive.sum().clamp_min(1)


def prune_focal(pruned: PruneOutput, near: Tensor, num_boxes: int, alpha: float = 0.25, gamma: float = 2.0) -> Tensor:
    """Sigmoid focal loss (Lin et al. 2017) on whether a cell lies near an object, divided by max(1, number of such
    cells).

    near: (N,), of find_nearby_objects, rows of num_boxes boxes.
    Every object has equal weight, however many cells it covers, because pruning a
    few cells removes a
    small object.
    """
    is_near, row = near >= 0, near + 1
    cells = row.new_zeros(num_boxes + 1).index_add_(0, row, torch.ones_like(row))
    number, objects = is_near.sum(), (cells[1:] > 0).sum()
    cell_weight = (number / (objects.clamp_min(1) * cells[row])).clamp_max(MAX_CELL_WEIGHT)
    p = torch.sigmoid(pruned.logit)
    right = torch.where(is_near, p, 1 - p)
    share = torch.where(is_near, alpha * cell_weight, 1 - alpha)
    entropy = functional.binary_cross_entropy_with_logits(pruned.logit, is_near.to(p.dtype), reduction="none")
    return (share * (1 - right) ** gamma * entropy).sum() / number.clamp_min(1)


def head_terms(raw: RawBoxes, targets: Targets, prune: Tensor, mask_l1: Tensor, information: Tensor) -> LossTerms:
    """Compute all terms of one batch; each is finite, and zero without targets."""
    return heads_terms([(raw, targets)], prune, mask_l1, information)[0]


def heads_terms(
    heads: Sequence[tuple[RawBoxes, Targets]], prune: Tensor, mask_l1: Tensor, information: Tensor
) -> list[LossTerms]:
    """Compute all terms of the heads of one grid, each with its targets, in one pass over the assigned sites of all."""
    rest = prune, mask_l1, information
    heat = [_heat_term(raw, targets) for raw, targets in heads]
    rows = [(targets.box >= 0).nonzero()[:, 0] for _, targets in heads]
    sizes = [len(part) for part in rows]
    if not sum(sizes):
        zeros = [raw.heatmap_logit.sum() * 0 for raw, _ in heads]
        return [LossTerms(h, zero, zero, zero, zero, zero, zero, zero, *rest) for h, zero in zip(heat, zeros)]
    some = RawBoxes.cat([raw.select(part) for (raw, _), part in zip(heads, rows)])
    truth = torch.cat(
        [_pack(t.boxes).index_select(0, t.box.index_select(0, part)) for (_, t), part in zip(heads, rows)]
    )
    weight = [targets.weight.index_select(0, part) for (_, targets), part in zip(heads, rows)]
    terms = []
    for first, part, scale in zip(heat, _row_terms(some, truth).split(sizes, 1), weight):
        # Without targets the sum is zero, and so is the mean.
        mean = (part * scale).sum(1) / scale.sum().clamp_min(torch.finfo(scale.dtype).tiny)
        shape, direction, kind, sigma, overlap, iou, speed = mean.unbind()
        terms.append(LossTerms(first, shape, direction, kind, sigma, overlap, iou, speed, *rest))
    return terms


def _pack(boxes: Boxes) -> Tensor:
    """Return (M, 10) float32: centre, size, yaw, velocity and label of boxes."""
    columns = (boxes.center, boxes.size, boxes.yaw[:, None], boxes.velocity, boxes.label[:, None])
    return torch.cat([column.to(torch.float32) for column in columns], 1)


def _row_terms(some: RawBoxes, truth: Tensor) -> Tensor:
    """Return (7, n) terms of n sites against their boxes, rows of _pack, in the order of LossTerms from shape on."""
    center, size, yaw, velocity, label = truth.split((3, 3, 1, 2, 1), 1)
    yaw, cell = yaw[:, 0], some.sites.grid.cell_size_m
    offset = (center[:, :2] - some.sites.xy) / cell
    log_size = (size / size.new_tensor(TYPICAL_SIZE)).log()
    axis = torch.stack(((2 * yaw).cos(), (2 * yaw).sin()), 1)
    off = (some.offset - offset).abs().sum(1) + (some.z - center[:, 2]).abs() * 0.2
    shape = off + (some.log_size - log_size).abs().sum(1) + (some.axis - axis).abs().sum(1) * 0.5
    # The axis is known modulo pi; the heading along it is a separate classification.
    turn = yaw - axis_yaw(some.axis).detach()
    ahead = (turn.cos() > 0).float()
    direction = functional.binary_cross_entropy_with_logits(heading_logit(some), ahead, reduction="none")
    kind = _kind_term(some, label[:, 0].long())
    sigma = _gaussian_nll(((some.offset - offset) * cell).detach(), some.log_sigma_xy)
    axis_error = torch.atan2((2 * turn).sin(), (2 * turn).cos())[:, None] / 2
    sigma = sigma + _gaussian_nll(axis_error, some.log_sigma_yaw)
    iou = aligned_iou(some.bev(), torch.cat((center[:, :2], size[:, :2], yaw[:, None]), 1))
    overlap = functional.binary_cross_entropy_with_logits(
        some.iou_logit, iou.detach().clamp(0, 1).float(), reduction="none"
    )
    speed = (some.velocity - velocity / SPEED_UNIT).abs().sum(1)
    return torch.stack((shape, direction, kind, sigma, overlap, 1 - iou, speed))


def _heat_term(raw: RawBoxes, targets: Targets) -> Tensor:
    """Return the focal loss of the heat map, or of those of all classes together."""
    if raw.class_heat is None or targets.class_heat is None or targets.class_positive is None:
        return centre_focal(raw.heatmap_logit, targets.heat, targets.positive)
    columns = zip(raw.class_heat.unbind(1), targets.class_heat.unbind(1), targets.class_positive.unbind(1))
    return torch.stack([centre_focal(*column) for column in columns]).sum()


def _kind_term(some: RawBoxes, label: Tensor) -> Tensor:
    """Return the cross-entropy (N,) of the kind of vehicle; 0 of people, whose class is that of their heat map."""
    if some.classes == VEHICLES:
        return functional.cross_entropy(some.class_logits, label, reduction="none")
    last = len(VEHICLE_LABELS) - 1
    entropy = functional.cross_entropy(some.class_logits, label.clamp_max(last), reduction="none")
    return torch.where(label <= last, entropy, 0.0)


def _gaussian_nll(error: Tensor, log_sigma: Tensor) -> Tensor:
    """Return the mean over axes of the negative log-likelihood of errors (N, d) under an isotropic sigma (N,); no gradient to
    errors.
    """
    bounded = log_sigma.clamp(-5, 3)[:, None]
    return (0.5 * (error * torch.exp(-bounded)) ** 2 + bounded).mean(1)
