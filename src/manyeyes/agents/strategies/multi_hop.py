# SPDX-License-Identifier: Apache-2.0
"""Fused messages: every agent sends what it made of its own and of others' tokens, as the letter of CoSTr Eq. 1 says.

The information of A returns to A through B, counted twice and as old as two messages; ``intermediate`` sends what each saw itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.perception_cache import PerceptionCache, is_consecutive
from manyeyes.agents.strategies.intermediate import IntermediateFusion, gather_ego_tokens
from manyeyes.agents.strategies.message_header import make_header
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class MultiHopFusion:
    """Sends the tokens of its last perception, dated as that was; before it has perceived, its own."""

    name: str = "intermediate-multihop"
    uses_history: bool = True

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """What the agent perceived at its last instant, if that was just before; else what it sees."""
        cache.process(frame)
        if cache.last_fused is None or not is_consecutive(frame, cache.last_fused[0]):
            return IntermediateFusion().compose_message(cache, frame)
        then, tokens = cache.last_fused
        score = torch.sigmoid(cache.detector.score_tokens(tokens))
        return replace(make_header(then, cache.detector.fingerprint), tokens=tokens, token_score=score)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the fused tokens, which are kept to be said."""
        with torch.inference_mode():
            around = gather_ego_tokens(
                frame, cache.process(frame).shared_tokens, cache.previous_tokens(frame), messages
            )
            fused = cache.detector.fuse_tokens(*around)
            raw = cache.detector.refine(fused.bev, fused.merged_proposals)
            cache.last_fused = frame, cache.detector.make_tokens(fused.bev, raw)
        return cache.decode(raw)
