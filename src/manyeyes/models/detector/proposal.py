# SPDX-License-Identifier: Apache-2.0
"""The predicted box of each token, which a change of frame transforms exactly.

A learned feature is relative to its sender's frame, and the receiver can rotate only its vector channels. A proposal holds the
outputs of the sender's own head (every agent perceives as ego before it shares, CoSTr section III-A), and a rigid motion of a box
is exact.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, RawBoxes

PROPOSAL_DIM = BOX_LAYOUT.total
"""Number of proposal columns: those of RawBoxes, in its order."""
NO_HEAT_LOGIT = -16.0
"""Heat of tokens that were sent without proposal and without confidence."""
MAX_PROPOSAL = 16.0
"""Largest magnitude of a value of a proposal."""


def make_proposals(raw: RawBoxes) -> Tensor:
    """Return proposals (N, PROPOSAL_DIM) from the head's outputs, without gradient."""
    return raw.to_rows().detach().clamp(-MAX_PROPOSAL, MAX_PROPOSAL)


def make_bare_proposals(heat: Tensor) -> Tensor:
    """Return proposals (N, PROPOSAL_DIM) of tokens that were sent without: heat logits (N,), no offset, no velocity."""
    return torch.cat((heat[:, None], heat.new_zeros(len(heat), PROPOSAL_DIM - 1)), 1)


def proposed_offset(proposal: Tensor) -> Tensor:
    """Return the offset (N, 2) from the token to the box centre, in cells."""
    return proposal[:, BOX_LAYOUT.offset]


def proposed_heat(proposal: Tensor) -> Tensor:
    """Return the logit (N,) that the token is at an object's centre."""
    return proposal[:, BOX_LAYOUT.heatmap_logit][:, 0]


def proposed_velocity(proposal: Tensor) -> Tensor:
    """Return the velocity (N, 2) of the object, metres per second."""
    return proposal[:, BOX_LAYOUT.velocity] * SPEED_UNIT


def reset_origin(proposal: Tensor, shift: Tensor) -> Tensor:
    """Change the origin of the offsets by (N, 2) cells."""
    moved = proposal.clone()
    moved[:, BOX_LAYOUT.offset] += shift
    return moved


def move_proposal(proposal: Tensor, yaw: Tensor, height: Tensor) -> Tensor:
    """Transform proposals to a frame in which the sender has a scalar yaw and its ground the height (N,), metres."""
    return turn_proposal(proposal, yaw.cos().to(proposal.dtype), yaw.sin().to(proposal.dtype), height)


def turn_proposal(proposal: Tensor, cosine: Tensor, sine: Tensor, height: Tensor) -> Tensor:
    """Do the same with the cosine and sine of the yaw, scalars or (N, 1) for senders of their own yaws."""
    double = cosine * cosine - sine * sine, 2 * cosine * sine
    once, moved = (cosine, sine), proposal.clone()
    spans = (
        (BOX_LAYOUT.offset, once),
        (BOX_LAYOUT.axis, double),
        (BOX_LAYOUT.direction, once),
        (BOX_LAYOUT.velocity, once),
    )
    for span, (c, s) in spans:
        x, y = proposal[:, span].split(1, 1)
        moved[:, span] = torch.cat((x * c - y * s, x * s + y * c), 1)
    moved[:, BOX_LAYOUT.z] += height[:, None]
    return moved
