# SPDX-License-Identifier: Apache-2.0
"""Multi-hop fusion: every agent sends its fused tokens, the literal reading of CoSTr Eq. 1.

Information of agent A returns to A through B, counted twice and two messages old; ``intermediate`` sends own tokens only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message


@register_strategy("intermediate-multihop")
@dataclass(frozen=True)
class MultiHopFusion(IntermediateFusion):
    """Sends the fused tokens of the last perception with its timestamp; own tokens before the first perception."""

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return the fused tokens of the previous frame if it is consecutive, else the agent's own tokens."""
        cache.process(frame)
        if cache.last_fused is None or not cache.is_consecutive(frame, cache.last_fused[0]):
            return super().compose_message(cache, frame, requests)
        then, tokens = cache.last_fused
        score = torch.sigmoid(cache.token_detector.score_tokens(tokens))
        score = self.weigh(cache, frame, tokens, score, requests)
        return replace(make_header(then, cache.detector.fingerprint), tokens=tokens, token_score=score)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the fused tokens; the tokens are stored for the next message."""
        fused, raw = cache.fuse(*self.gather(cache, frame, messages))
        with torch.inference_mode():
            cache.last_fused = frame, cache.token_detector.make_tokens(fused.bev, raw)
        return cache.decode(raw)


register_strategy("intermediate-multihop-temporal")(partial(MultiHopFusion, novelty_score, uses_history=True))
