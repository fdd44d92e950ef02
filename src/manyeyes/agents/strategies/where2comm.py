# SPDX-License-Identifier: Apache-2.0
"""Where2comm's selection (Hu et al., NeurIPS 2022, section 3.3): the sender's smoothed confidence times what receivers request.

A receiver requests where it is not confident. Its map has one byte a window (``comms.request_map``) instead of one number a cell,
and a sender knows the maps of the last messages: the first message of all is selected by confidence alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion, confidence_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.comms.request_map import compute_request_weights
from manyeyes.datatypes import AgentFrame, Message, SparseBev
from manyeyes.ops.sparse_conv import submanifold_conv

MIN_SCORE = 0.01
"""Tokens with a lower confidence, weighted by requests, are not sent."""
_KERNEL, _SIGMA_CELLS = 5, 1.0


def smoothed_confidence(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Return the confidence (N,) of the shared tokens, smoothed over cells by a Gaussian of one cell; empty cells are zero."""
    tokens = cache.process_tokens(frame).shared_tokens
    at = torch.arange(_KERNEL) - _KERNEL // 2
    line = torch.exp(-0.5 * (at / _SIGMA_CELLS) ** 2)
    weight = line[:, None] * line / line.sum() ** 2
    confidence = tokens.with_features(confidence_score(cache, frame)[:, None])
    return submanifold_conv(confidence, weight[None, None]).features[:, 0]


def weigh_by_demand(
    cache: PerceptionCache, frame: AgentFrame, tokens: SparseBev, score: Tensor, requests: Sequence[Message]
) -> Tensor:
    """Weigh the scores (N,) of tokens by 1 - confidence of the receiver that requests most; unrequested tokens are not sent."""
    weights = compute_request_weights(tokens.sites.xy, frame.world_from_agent, requests, min_weight=0.0)
    weighted = score * weights
    return torch.where(weighted > MIN_SCORE, weighted, -torch.inf)


class Where2commFusion(IntermediateFusion):
    """Tokens by confidence and request; each message carries a request map."""

    needs_request_map = True


for name, uses_history in (("intermediate-where2comm", False), ("intermediate-where2comm-temporal", True)):
    register_strategy(name)(partial(Where2commFusion, smoothed_confidence, uses_history, weigh=weigh_by_demand))
