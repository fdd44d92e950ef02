# SPDX-License-Identifier: Apache-2.0
"""How2comm's gate at the sender (Yang et al., NeurIPS 2023): a token is sent where receivers request and the sender attends.

A receiver broadcasts its spatial attention instead of the confidence of a request map, one byte a window, the least of a window; a
sender gates by the maps of the last messages, and by its own attention alone before any came. Weights of the fusion ``how2comm``
have the gate; others send as ``intermediate`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion, weigh_by_requests
from manyeyes.agents.strategies.redundancy import distinct_score, novelty_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.agents.strategies.request_maps import REQUEST_MAP_STRIDE
from manyeyes.comms.request_map import build_request_map, compute_request_weights
from manyeyes.datatypes import AgentFrame, Message, SparseBev
from manyeyes.models.detector.detector import Detector
from manyeyes.models.fusion.how2comm import MIN_SHARE


def weigh_by_gate(
    cache: PerceptionCache, frame: AgentFrame, tokens: SparseBev, score: Tensor, requests: Sequence[Message]
) -> Tensor:
    """Return the gates (N,) of tokens as their scores; tokens of a closed gate are not sent."""
    detector = cache.detector
    if not isinstance(detector, Detector) or not detector.has_gate:
        return weigh_by_requests(cache, frame, tokens, score, requests)
    request = compute_request_weights(tokens.sites.xy, frame.world_from_agent, requests, min_weight=0.0)
    with torch.inference_mode():
        gate = detector.gate_tokens(tokens, request)
    return torch.where(gate > MIN_SHARE, gate, -torch.inf)


class How2commFusion(IntermediateFusion):
    """Tokens whose gate is open, with the attention of their sender as a request map."""

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return the tokens that the gate passes, the gates as scores, and the map of attention."""
        message, detector = super().compose_message(cache, frame, requests), cache.detector
        if message is None or not isinstance(detector, Detector) or not detector.has_gate:
            return message
        tokens = cache.process_tokens(frame).shared_tokens
        with torch.inference_mode():
            attention = detector.attend_tokens(tokens).clamp(0, 1)
        windows = detector.grid.at(REQUEST_MAP_STRIDE)
        return replace(message, request=build_request_map(tokens.sites.xy, attention, windows))


@register_strategy("intermediate-how2comm")
def _without_memory() -> How2commFusion:
    return How2commFusion(distinct_score, weigh=weigh_by_gate)


@register_strategy("intermediate-how2comm-temporal")
def _with_memory() -> How2commFusion:
    return How2commFusion(novelty_score, uses_history=True, weigh=weigh_by_gate)
