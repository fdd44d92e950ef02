# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion: every agent sends tokens; the ego moves them into its frame and fuses them (CoSTr Eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from manyeyes.agents.collaboration.heading import ego_from_sender, header
from manyeyes.agents.eyes import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, Message, Transform
from manyeyes.models.fusion.gather import gather


@dataclass(frozen=True)
class Intermediate:
    """Tokens of the weights that the ego carries itself; the inbox refuses others."""

    name: str = "intermediate"

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """The tokens that pruning kept with what the agent makes of them, and their worth, by which a budget chooses."""
        seen = eyes.see(frame)
        return replace(header(frame, eyes.detector.fingerprint), tokens=seen.told, token_score=seen.worth)

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the fused tokens."""
        own = eyes.see(frame).told
        parts: list[tuple[int, Tensor, Tensor, Transform | None]] = [(0, own.features, own.sites.xy, None)]
        for message in messages:
            if message.tokens is not None and message.tokens.grid == own.grid:
                there = message.tokens
                parts.append((0, there.features, there.sites.xy, ego_from_sender(frame, message)))
        return eyes.decode(eyes.fuse(gather(parts, own.grid, 1)))
