# SPDX-License-Identifier: Apache-2.0
"""Encode proposals in bytes: each quantity by a fixed rule of one byte, equal for all weights.

The quantisation error is at most half a step: 1.4 cm in x and y at a cell of 1.6 m, 2 cm in z, 0.35 degrees, 0.63 % of each size,
0.125 m/s; the sigmas within 22 %. Values beyond 127 steps saturate. The heading logit is stored along the box axis. Of the class
logits, the best and its lead are stored. The length of ``axis`` is not sent; it is 1 for a confident head.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from manyeyes.datatypes import VEHICLE_LABELS
from manyeyes.models.detector._code_kernels import CodeRules
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, axis_yaw
from manyeyes.models.detector.proposal import PROPOSAL_DIM

_STEPS = (
    (BOX_LAYOUT.heatmap_logit, 1 / 16),
    # Offsets beyond MAX_OFFSET_CELLS of fusion.token_merge are not followed; saturated values stay beyond it.
    (BOX_LAYOUT.offset, 2.25 / 127),
    (BOX_LAYOUT.z, 0.04),
    (BOX_LAYOUT.log_size, 0.0125),
    (BOX_LAYOUT.iou_logit, 1 / 16),
    (BOX_LAYOUT.velocity, 0.25 / SPEED_UNIT),
)
AXIS_STEP = 256 / math.pi
"""Bytes of the code of an axis per radian."""
_FACING_STEP = 1 / 8
_LEADS = 256 // len(VEHICLE_LABELS)
_LEAD_STEP = 16 / _LEADS
_SIGMA_LOW, _SIGMA_STEP = -4.0, 0.4


def _table() -> tuple[Tensor, Tensor]:
    """Return columns of a proposal that are encoded one by one, and their quantisation steps."""
    pairs = [(column, step) for span, step in _STEPS for column in range(span.start, span.stop)]
    return torch.tensor([c for c, _ in pairs], device="cpu"), torch.tensor([s for _, s in pairs], device="cpu")


_COLUMNS, _COLUMN_STEPS = _table()
PROPOSAL_CODES = len(_COLUMNS) + 4
"""Bytes of an encoded proposal: the single columns, then axis, direction, class, and both sigmas in one."""


_AXIS_BYTES = torch.arange(256, device="cpu").float()


def make_code_rules() -> CodeRules:
    """Return the rules of decoding for compiled loops."""
    turn, layout = _AXIS_BYTES * (2 * math.pi / 256), BOX_LAYOUT
    return CodeRules(
        _COLUMNS.numpy(), _COLUMN_STEPS.numpy(), torch.stack((turn.cos(), turn.sin()), 1).numpy(), _along(_AXIS_BYTES).numpy(),
        layout.axis.start, layout.direction.start, layout.class_logits.start, layout.log_sigma_xy.start,
        layout.log_sigma_yaw.start, len(VEHICLE_LABELS), _LEADS, _LEAD_STEP, _FACING_STEP, _SIGMA_LOW, _SIGMA_STEP,
    )  # fmt: skip


def proposal_to_codes(proposal: Tensor) -> Tensor:
    """Encode proposals (N, PROPOSAL_DIM) to (N, PROPOSAL_CODES) uint8."""
    columns, steps = (part.to(proposal.device) for part in (_COLUMNS, _COLUMN_STEPS))
    single = _encode_signed(proposal[:, columns], steps)
    axis = torch.remainder(torch.round(axis_yaw(proposal[:, BOX_LAYOUT.axis]) * AXIS_STEP), 256)
    facing = (proposal[:, BOX_LAYOUT.direction] * _along(axis)).sum(1)
    best = proposal[:, BOX_LAYOUT.class_logits].topk(2, dim=1)
    lead = torch.floor((best.values[:, 0] - best.values[:, 1]) / _LEAD_STEP).clamp(0, _LEADS - 1)
    sigma = [proposal[:, c][:, 0] for c in (BOX_LAYOUT.log_sigma_xy, BOX_LAYOUT.log_sigma_yaw)]
    nibbles = [torch.round((s - _SIGMA_LOW) / _SIGMA_STEP).clamp(0, 15) for s in sigma]
    rest = (
        axis,
        _encode_signed(facing, _FACING_STEP),
        best.indices[:, 0] * _LEADS + lead,
        nibbles[0] * 16 + nibbles[1],
    )
    return torch.cat((single, torch.stack(rest, 1)), 1).to(torch.uint8)


def proposal_from_codes(codes: Tensor) -> Tensor:
    """Decode (N, PROPOSAL_CODES) uint8 to (N, PROPOSAL_DIM) float32; any bytes are valid."""
    code = codes.float()
    axis, facing, kind, sigma = code[:, -4:].unbind(1)
    proposal = code.new_zeros(len(code), PROPOSAL_DIM)
    columns, steps = (part.to(code.device) for part in (_COLUMNS, _COLUMN_STEPS))
    proposal[:, columns] = (code[:, :-4] - 128) * steps
    turn = axis * (2 * math.pi / 256)
    proposal[:, BOX_LAYOUT.axis] = torch.stack((turn.cos(), turn.sin()), 1)
    proposal[:, BOX_LAYOUT.direction] = ((facing - 128) * _FACING_STEP)[:, None] * _along(axis)
    # The middle of its step: never 0, so that the best class stays the best.
    lead = (torch.remainder(kind, _LEADS) + 0.5) * (_LEAD_STEP / 2)
    named = torch.arange(len(VEHICLE_LABELS), device=code.device) == kind.div(_LEADS, rounding_mode="floor")[:, None]
    proposal[:, BOX_LAYOUT.class_logits] = torch.where(named, lead[:, None], -lead[:, None])
    nibbles = torch.stack((sigma.div(16, rounding_mode="floor"), torch.remainder(sigma, 16)), 1)
    proposal[:, [BOX_LAYOUT.log_sigma_xy.start, BOX_LAYOUT.log_sigma_yaw.start]] = _SIGMA_LOW + _SIGMA_STEP * nibbles
    return proposal


def _encode_signed(value: Tensor, step: Tensor | float) -> Tensor:
    """Encode whole steps as 1 … 255, with 128 for 0."""
    return torch.round(value / step).clamp(-127, 127) + 128


def _along(axis: Tensor) -> Tensor:
    """Return a unit vector (N, 2) along the axis of a code (N,); either sign gives the same code."""
    yaw = axis * (math.pi / 256)
    return torch.stack((yaw.cos(), yaw.sin()), 1)
