# SPDX-License-Identifier: Apache-2.0
"""CodeFilling's selection (Hu et al., CVPR 2024): senders fill the demand of a receiver in the order of their confidence.

At a position the confidences of the receiver, and of senders from the most confident one on, add up; a sender sends while the sum
that includes its own stays below the demand. Confidences are those of request maps, one byte a window, of the last messages of all
agents; before any came, everything is sent. Codes are those of the codebook of the weights, which is fitted by k-means. The fusion
is the maximum: weights of ``fusion/max``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion, confidence_score
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.agents.strategies.request_maps import make_request_map
from manyeyes.comms.request_map import read_request_map
from manyeyes.datatypes import AgentFrame, Message, SparseBev
from manyeyes.datatypes.message import RequestMap

DEMAND = 1.0
"""Sum of confidences at which the demand of a position is met."""
MIN_CONFIDENCE = 0.01
"""Tokens with a lower confidence of the sender are not sent."""


@dataclass(frozen=True)
class KnownConfidence:
    """Confidence (N,) of an agent at positions, and whether they are on its map (N,)."""

    agent_id: int
    confidence: Tensor
    is_inside: Tensor


def select_by_filling(own: KnownConfidence, others: Sequence[KnownConfidence], demand: float) -> Tensor:
    """Return whether an agent sends its tokens (N,): whether one of the others, as a receiver, still needs them.

    Before the agent, those fill that are more confident; of equally confident ones, those of lower ids.
    """
    is_sent = torch.zeros(len(own.confidence), dtype=torch.bool)
    for receiver in others:
        total = receiver.confidence + own.confidence
        for other in others:
            if other is not receiver:
                is_equal = other.confidence == own.confidence
                is_before = (other.confidence > own.confidence) | (is_equal & (other.agent_id < own.agent_id))
                total = total + torch.where(is_before & other.is_inside, other.confidence, 0.0)
        is_sent |= receiver.is_inside & (total < demand)
    return is_sent


def weigh_by_filling(
    cache: PerceptionCache, frame: AgentFrame, tokens: SparseBev, score: Tensor, requests: Sequence[Message]
) -> Tensor:
    """Return the scores (N,) of tokens; those that fill no demand are not sent."""
    is_sent = score > MIN_CONFIDENCE
    others = [_read(tokens, frame, message, message.request) for message in requests if message.request is not None]
    if others:
        mine = make_header(frame, cache.detector.fingerprint)
        own = _read(tokens, frame, mine, make_request_map(cache, frame))
        is_sent &= select_by_filling(own, others, DEMAND)
    return torch.where(is_sent, score, -torch.inf)


def _read(tokens: SparseBev, frame: AgentFrame, message: Message, request: RequestMap) -> KnownConfidence:
    """Return the confidence of a message's sender at the tokens."""
    read = read_request_map(tokens.sites.xy, frame.world_from_agent, message.world_from_agent, request)
    return KnownConfidence(message.agent_id, *read)


class CodeFillingFusion(IntermediateFusion):
    """Tokens by confidence, as far as they fill a demand; each message carries a request map."""

    needs_request_map = True


for name, uses_history in (("intermediate-codefilling", False), ("intermediate-codefilling-temporal", True)):
    register_strategy(name)(partial(CodeFillingFusion, confidence_score, uses_history, weigh=weigh_by_filling))
