# SPDX-License-Identifier: Apache-2.0
"""What an agent has not said yet: the order in which a budget keeps its tokens.

Whoever hears an agent remembers its last messages (``agents.message_history``), so the next word is best spent on an object
that none of them spoke of. A token is worth its sender's confidence, less for each word on the same object that comes before
it: a surer one of the same message, and those of the last messages, which count once. It is said again, late, where nothing
else is as likely. Compare CoSTr section III-E, which asks what a message adds to what its receiver has; here that is what the
sender said itself. A receiver that lost those messages hears of the object again within three.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import Eyes
from manyeyes.datatypes import AgentFrame, SparseBev
from manyeyes.models.detector.proposal import PROPOSAL, proposed_heat, proposed_offset, proposed_velocity

AGAIN = 0.7
"""What a word on an object leaves of the worth of the next; chosen on Town07 (0.5 to 0.85 do about as well)."""
SAME_OBJECT_M = 2.0
"""Tokens speak of one object where the centres that they propose are nearer."""


def unsaid(eyes: Eyes, frame: AgentFrame) -> Tensor:
    """(N,) in [0, 1], of the tokens that the agent tells of this frame: sigmoid(heat) * AGAIN^(words before it)."""
    told = eyes.see(frame).told
    place, heat = centres(told), proposed_heat(told.features[:, -PROPOSAL:])
    turn = heat.argsort(descending=True, stable=True).argsort()
    surer = turn[None, :] < turn[:, None]
    words = (surer & (torch.cdist(place, place) < SAME_OBJECT_M)).sum(1)
    known = torch.cat([place.new_empty(0, 2), *(_now(frame, then, said) for then, said in eyes.said_before(frame))])
    words += (torch.cdist(place, known) < SAME_OBJECT_M).any(1)
    return torch.sigmoid(heat) * AGAIN**words


def centres(told: SparseBev) -> Tensor:
    """(N, 2) metres: the centre of the object that each token (N, C + PROPOSAL) proposes."""
    return told.sites.xy + proposed_offset(told.features[:, -PROPOSAL:]) * told.grid.cell


def _now(frame: AgentFrame, then: AgentFrame, said: SparseBev) -> Tensor:
    """(N, 2): where the objects of tokens of an earlier frame should be by now, in this one."""
    seconds = (frame.timestamp_ns - then.timestamp_ns) / 1e9
    xy = centres(said) + proposed_velocity(said.features[:, -PROPOSAL:]) * seconds
    moved = frame.from_earlier(then).apply(torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double())
    return moved[:, :2].to(xy.dtype)
