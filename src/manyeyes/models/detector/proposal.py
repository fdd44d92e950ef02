# SPDX-License-Identifier: Apache-2.0
"""The predicted box of each token, which a change of frame transforms exactly.

A learned feature is relative to its sender's frame, and the receiver can rotate only its vector channels. A proposal
holds the
outputs of the sender's own head (every agent perceives as ego before it shares, CoSTr section III-A), and a rigid
motion of a box is
exact.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT, RawBoxes

PROPOSAL_DIM = BOX_LAYOUT.total
"""Number of proposal columns: those of RawBoxes, in its order."""


def make_proposals(raw: RawBoxes) -> Tensor:
    """Return proposals (N, PROPOSAL_DIM) from the head's outputs, without gradient."""
    return raw.to_rows().detach().clamp(-16, 16)


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
