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

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_offset, proposed_velocity

REDUNDANCY_DECAY = 0.7
"""What a word on an object leaves of the worth of the next; chosen on Town07 (0.5 to 0.85 do about as well)."""
SAME_OBJECT_M = 2.0
"""Tokens speak of one object where the centres that they propose are nearer."""


def novelty_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """(N,) in [0, 1], of the tokens that the agent tells of this frame: sigmoid(heat) * AGAIN^(words before it)."""
    tokens = cache.process(frame).shared_tokens
    place, heat = proposed_centres(tokens), proposed_heat(tokens.features[:, -PROPOSAL_DIM:])
    rank = heat.argsort(descending=True, stable=True).argsort()
    more_confident = rank[None, :] < rank[:, None]
    num_earlier = (more_confident & (torch.cdist(place, place) < SAME_OBJECT_M)).sum(1)
    sent_centres = torch.cat(
        [place.new_empty(0, 2), *(_propagate_centres(frame, then, sent) for then, sent in cache.recently_sent(frame))]
    )
    num_earlier += (torch.cdist(place, sent_centres) < SAME_OBJECT_M).any(1)
    return torch.sigmoid(heat) * REDUNDANCY_DECAY**num_earlier


def proposed_centres(tokens: SparseBev) -> Tensor:
    """(N, 2) metres: the centre of the object that each token (N, C + PROPOSAL) proposes."""
    return tokens.sites.xy + proposed_offset(tokens.features[:, -PROPOSAL_DIM:]) * tokens.grid.cell_size_m


def _propagate_centres(frame: AgentFrame, then: AgentFrame, sent: SparseBev) -> Tensor:
    """(N, 2): where the objects of tokens of an earlier frame should be by now, in this one."""
    seconds = (frame.timestamp_ns - then.timestamp_ns) / 1e9
    xy = proposed_centres(sent) + proposed_velocity(sent.features[:, -PROPOSAL_DIM:]) * seconds
    moved = frame.now_from_earlier(then).apply(torch.cat((xy, xy.new_zeros(len(xy), 1)), 1).double())
    return moved[:, :2].to(xy.dtype)
