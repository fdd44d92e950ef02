# SPDX-License-Identifier: Apache-2.0
"""What an agent believes of each of its tokens' object, in numbers that move exactly when the frame moves.

A learned feature is written in its sender's frame; the receiver can turn its vectors but not know what they mean. A proposal
is all that the sender's own head said of the token (it has perceived as ego before it serves others, CoSTr section III-A),
and a rigid motion of a box is known to the last digit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, RawBoxes

PROPOSAL_DIM = BOX_LAYOUT.total
"""Columns of a proposal: those of RawBoxes, in its order."""


def make_proposals(raw: RawBoxes) -> Tensor:
    """(N, PROPOSAL) of what the head said of each site; a statement, so it carries no gradient."""
    return raw.to_rows().detach().clamp(-16, 16)


def proposed_offset(proposal: Tensor) -> Tensor:
    """(N, 2): from the token's own place to the centre of the box, in cells."""
    return proposal[:, BOX_LAYOUT.offset]


def proposed_heat(proposal: Tensor) -> Tensor:
    """(N,): the logit that the token is the middle of an object."""
    return proposal[:, BOX_LAYOUT.heatmap_logit][:, 0]


def proposed_velocity(proposal: Tensor) -> Tensor:
    """(N, 2): of the object, metres per second."""
    return proposal[:, BOX_LAYOUT.velocity] * SPEED_UNIT


def reset_origin(proposal: Tensor, shift: Tensor) -> Tensor:
    """The same boxes, measured from places that lie (N, 2) cells before the tokens' own."""
    moved = proposal.clone()
    moved[:, BOX_LAYOUT.offset] += shift
    return moved


def move_proposal(proposal: Tensor, yaw: Tensor, height: Tensor) -> Tensor:
    """The same statements in a frame that sees the sender turned by yaw, a scalar, and its ground at height (N,), metres."""
    c, s = yaw.cos().to(proposal.dtype), yaw.sin().to(proposal.dtype)
    once = torch.stack((torch.stack((c, s)), torch.stack((-s, c))))
    twice = once @ once
    moved = proposal.clone()
    moved[:, BOX_LAYOUT.offset] = proposal[:, BOX_LAYOUT.offset] @ once
    moved[:, BOX_LAYOUT.z] += height[:, None]
    moved[:, BOX_LAYOUT.axis] = proposal[:, BOX_LAYOUT.axis] @ twice
    moved[:, BOX_LAYOUT.direction] = proposal[:, BOX_LAYOUT.direction] @ once
    moved[:, BOX_LAYOUT.velocity] = proposal[:, BOX_LAYOUT.velocity] @ once
    return moved
