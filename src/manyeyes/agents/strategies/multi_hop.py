# SPDX-License-Identifier: Apache-2.0
"""Fused messages: every agent sends what it made of its own and of others' tokens, as the letter of CoSTr Eq. 1 says.

The information of A returns to A through B, counted twice and as old as two messages; ``intermediate`` sends what each saw itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.perception_cache import Eyes, follows
from manyeyes.agents.strategies.intermediate import Intermediate, tokens_around
from manyeyes.agents.strategies.message_header import header
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class Fused:
    """Sends the tokens of its last perception, dated as that was; before it has perceived, its own."""

    name: str = "fused"
    remembers: bool = True

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """What the agent perceived at its last instant, if that was just before; else what it sees."""
        eyes.see(frame)
        if eyes.perceived is None or not follows(frame, eyes.perceived[0]):
            return Intermediate().say(eyes, frame)
        then, told = eyes.perceived
        worth = torch.sigmoid(eyes.detector.choose(told))
        return replace(header(then, eyes.detector.fingerprint), tokens=told, token_score=worth)

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the fused tokens, which are kept to be said."""
        with torch.inference_mode():
            around = tokens_around(frame, eyes.see(frame).told, eyes.past(frame), messages)
            fused = eyes.detector.merge(*around)
            raw = eyes.detector.refine(fused.bev, fused.given)
            eyes.perceived = frame, eyes.detector.tell(fused.bev, raw)
        return eyes.decode(raw)
