# SPDX-License-Identifier: Apache-2.0
"""Redundancy-aware token scores: the order in which a budget keeps tokens.

Receivers keep the last messages of a sender (``agents.message_history``), so a token of an object that these messages do not cover
has the highest value. A token's score is its confidence, reduced for each earlier token of the same object: more confident ones of
the same message, and those of the last messages, which count once. CoSTr section III-E scores what a message adds to the receiver's
features; here the sender uses its own messages instead. An object is sent again within three messages, in case they were lost.

Tokens below the weights' ``DetectorConfig.min_sent_score`` score -inf, which no message holds, whatever its budget.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.agents._distance_kernels import count_earlier, propagate_centres
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT, SPEED_UNIT
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_offset

REDUNDANCY_DECAY = 0.7
"""Factor on the score for each earlier token of the same object; chosen on Town07 (0.5 to 0.85 are similar)."""
SAME_OBJECT_M = 2.0
"""Tokens with proposed centres closer than this belong to one object."""


def novelty_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return (N,) of the shared tokens of a frame: sigmoid(heat) * REDUNDANCY_DECAY^(earlier tokens of the object), or -inf."""
    tokens = cache.process_tokens(frame).shared_tokens
    sent_centres = [_propagate_centres(cache, frame, then, sent) for then, sent in cache.recently_sent(frame)]
    score = _decay_scores(tokens, torch.cat([tokens.features.new_empty(0, 2), *sent_centres]))
    return _drop_low(cache, score)


def distinct_score(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return ``novelty_score`` for receivers that remember no message: only tokens of the same message count as earlier."""
    tokens = cache.process_tokens(frame).shared_tokens
    return _drop_low(cache, _decay_scores(tokens, tokens.features.new_empty(0, 2)))


def _drop_low(cache: PerceptionCache, score: Tensor) -> Tensor:
    """Return the scores (N,) with -inf for those below the least one of the weights; detectors of third parties may have none."""
    return score.masked_fill(score < getattr(cache.detector, "min_sent_score", 0.0), -torch.inf)


def _decay_scores(tokens: SparseBev, sent_centres: Tensor) -> Tensor:
    """Return scores (N,) of tokens, of which receivers have the objects around sent_centres (M, 2)."""
    place, heat = proposed_centres(tokens), proposed_heat(tokens.features[:, -PROPOSAL_DIM:])
    arrays = [t.float().contiguous().numpy() for t in (place, heat, sent_centres)]
    num_earlier = torch.from_numpy(count_earlier(arrays[0], arrays[1], arrays[2], SAME_OBJECT_M))
    return torch.sigmoid(heat) * REDUNDANCY_DECAY**num_earlier


def proposed_centres(tokens: SparseBev) -> Tensor:
    """Return (N, 2) metres: the centre of the object that each token (N, C + PROPOSAL) proposes."""
    return tokens.sites.xy + proposed_offset(tokens.features[:, -PROPOSAL_DIM:]) * tokens.grid.cell_size_m


def _propagate_centres(cache: PerceptionCache, frame: AgentFrame, then: AgentFrame, sent: SparseBev) -> Tensor:
    """Return (N, 2): proposed centres of an earlier frame's tokens, propagated to this frame."""
    seconds, motion = (frame.timestamp_ns - then.timestamp_ns) / 1e9, cache.motion_since(frame, then).double()
    first = sent.features.shape[1] - PROPOSAL_DIM
    centres = propagate_centres(
        sent.features.float().contiguous().numpy(),
        sent.sites.xy.numpy(),
        (first + BOX_LAYOUT.offset.start, first + BOX_LAYOUT.velocity.start),
        (float(sent.grid.cell_size_m), SPEED_UNIT * seconds),
        (motion.rotation.contiguous().numpy(), motion.translation.contiguous().numpy()),
    )
    return torch.from_numpy(centres).to(sent.features.dtype)
