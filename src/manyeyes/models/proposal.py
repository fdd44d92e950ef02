# SPDX-License-Identifier: Apache-2.0
"""What an agent believes of each of its tokens' object, in numbers that move exactly when the frame moves.

A learned feature is written in its sender's frame; the receiver can turn its vectors but not know what they mean. A proposal
is the sender's own box for the token (it has perceived as ego before it serves others, CoSTr section III-A), and a rigid
motion of a box is known to the last digit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.box_head import RawBoxes

PROPOSAL = 8
"""heat, offset x and y (cells), z (m), log length, log width, cosine and sine of twice the yaw."""


def propose(raw: RawBoxes) -> Tensor:
    """(N, PROPOSAL) of what the head said of each site; a statement, so it carries no gradient. Heat is scaled to a few units."""
    heat = raw.heat.clamp(-8, 8) / 4
    columns = (heat[:, None], raw.offset, raw.z[:, None], raw.log_size[:, :2], raw.axis)
    return torch.cat(columns, 1).detach().clamp(-16, 16)


def move_proposal(proposal: Tensor, yaw: Tensor, height: Tensor) -> Tensor:
    """The same statements in a frame that sees the sender turned by yaw, a scalar, and its ground at height (N,), metres."""
    c, s = yaw.cos().to(proposal.dtype), yaw.sin().to(proposal.dtype)
    c2, s2 = c * c - s * s, 2 * s * c
    heat, x, y, z, length, width, ahead, across = proposal.unbind(1)
    turned = (
        heat,
        x * c - y * s,
        x * s + y * c,
        z + height,
        length,
        width,
        ahead * c2 - across * s2,
        ahead * s2 + across * c2,
    )
    return torch.stack(turned, 1)
