# SPDX-License-Identifier: Apache-2.0
"""A proposal as bytes: each quantity by a fixed rule of one byte, the same for all weights.

What the receiver reads is within half a step of what was said: 1.4 cm in each of x and y at a cell of 1.6 m, 2 cm in z, 0.35
degrees, 0.63 % of each size, 0.125 m/s; the sigmas within 22 %. Values beyond 127 steps saturate. The logit of a direction is
kept along the body's axis, where alone it is read; of the kinds' logits, the best and by how much it leads. The length of
``axis`` is not sent: it is 1 where the head is sure.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from manyeyes.datatypes import LABELS
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, axis_yaw
from manyeyes.models.detector.proposal import PROPOSAL_DIM

_STEPS = (
    (BOX_LAYOUT.heatmap_logit, 1 / 16),
    # Beyond fusion.settle.REACH_CELLS a proposal is not followed: what saturates stays beyond.
    (BOX_LAYOUT.offset, 2.25 / 127),
    (BOX_LAYOUT.z, 0.04),
    (BOX_LAYOUT.log_size, 0.0125),
    (BOX_LAYOUT.iou_logit, 1 / 16),
    (BOX_LAYOUT.velocity, 0.25 / SPEED_UNIT),
)
_FACING_STEP = 1 / 8
_LEADS = 256 // len(LABELS)
_LEAD_STEP = 16 / _LEADS
_SIGMA_LOW, _SIGMA_STEP = -4.0, 0.4


def _table() -> tuple[Tensor, Tensor]:
    """The columns of a proposal that are written one by one, and the step of each."""
    pairs = [(column, step) for span, step in _STEPS for column in range(span.start, span.stop)]
    return torch.tensor([c for c, _ in pairs]), torch.tensor([s for _, s in pairs])


_COLUMNS, _COLUMN_STEPS = _table()
PROPOSAL_CODES = len(_COLUMNS) + 4
"""Bytes of a coded proposal: the single columns, then axis, direction, kind, and both sigmas in one."""


def proposal_to_codes(proposal: Tensor) -> Tensor:
    """(N, PROPOSAL) to (N, PROPOSAL_CODES) uint8."""
    single = _signed(proposal[:, _COLUMNS], _COLUMN_STEPS)
    axis = torch.remainder(torch.round(axis_yaw(proposal[:, BOX_LAYOUT.axis]) * (256 / math.pi)), 256)
    facing = (proposal[:, BOX_LAYOUT.direction] * _along(axis)).sum(1)
    best = proposal[:, BOX_LAYOUT.class_logits].topk(2, dim=1)
    lead = torch.floor((best.values[:, 0] - best.values[:, 1]) / _LEAD_STEP).clamp(0, _LEADS - 1)
    sigma = [proposal[:, c][:, 0] for c in (BOX_LAYOUT.log_sigma_xy, BOX_LAYOUT.log_sigma_yaw)]
    nibbles = [torch.round((s - _SIGMA_LOW) / _SIGMA_STEP).clamp(0, 15) for s in sigma]
    rest = (axis, _signed(facing, _FACING_STEP), best.indices[:, 0] * _LEADS + lead, nibbles[0] * 16 + nibbles[1])
    return torch.cat((single, torch.stack(rest, 1)), 1).to(torch.uint8)


def proposal_from_codes(codes: Tensor) -> Tensor:
    """The inverse: (N, PROPOSAL_CODES) uint8 to (N, PROPOSAL) float32; any bytes stand for some proposal."""
    code = codes.float()
    axis, facing, kind, sigma = code[:, -4:].unbind(1)
    proposal = code.new_zeros(len(code), PROPOSAL_DIM)
    proposal[:, _COLUMNS] = (code[:, :-4] - 128) * _COLUMN_STEPS
    turn = axis * (2 * math.pi / 256)
    proposal[:, BOX_LAYOUT.axis] = torch.stack((turn.cos(), turn.sin()), 1)
    proposal[:, BOX_LAYOUT.direction] = ((facing - 128) * _FACING_STEP)[:, None] * _along(axis)
    # The middle of its step: never 0, so that the best stays the best.
    lead = (torch.remainder(kind, _LEADS) + 0.5) * (_LEAD_STEP / 2)
    named = torch.arange(len(LABELS)) == kind.div(_LEADS, rounding_mode="floor")[:, None]
    proposal[:, BOX_LAYOUT.class_logits] = torch.where(named, lead[:, None], -lead[:, None])
    nibbles = torch.stack((sigma.div(16, rounding_mode="floor"), torch.remainder(sigma, 16)), 1)
    proposal[:, [BOX_LAYOUT.log_sigma_xy.start, BOX_LAYOUT.log_sigma_yaw.start]] = _SIGMA_LOW + _SIGMA_STEP * nibbles
    return proposal


def _signed(value: Tensor, step: Tensor | float) -> Tensor:
    """Whole steps from 0 as 1 … 255; 0 is 128."""
    return torch.round(value / step).clamp(-127, 127) + 128


def _along(axis: Tensor) -> Tensor:
    """(N, 2): a unit vector along the axis of a code (N,); which of the two makes no difference to what is written along it."""
    yaw = axis * (math.pi / 256)
    return torch.stack((yaw.cos(), yaw.sin()), 1)
