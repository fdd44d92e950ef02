# SPDX-License-Identifier: Apache-2.0
"""The strategy of a malicious agent: that of an honest one, whose message an attack replaces before selection and encoding."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import FusionStrategy
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.studies.attacks.interface import AttackOutput, FalseClaims

Alter = Callable[[PerceptionCache, AgentFrame, Message], AttackOutput]
"""Replaces the honest message of a levelled frame."""


class MaliciousStrategy(FusionStrategy):
    """Compose as another strategy does, then alter the message; fuse as the other one. claims: of the last message."""

    def __init__(self, honest: FusionStrategy, alter: Alter) -> None:
        self._honest, self._alter = honest, alter
        self.uses_history, self.needs_tokens = honest.uses_history, honest.needs_tokens
        self.uses_points, self.waits_for_messages = honest.uses_points, honest.waits_for_messages
        self.needs_request_map = getattr(honest, "needs_request_map", False)
        self.score_form = honest.score_form
        self.claims = FalseClaims()

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return what the attack makes of the honest message; None where nothing is sent."""
        self.claims = FalseClaims()
        message = self._honest.compose_message(cache, frame, requests)
        if message is None:
            return None
        output = self._alter(cache, frame, message)
        self.claims = output.claims
        return output.message

    def record_sent(self, cache: PerceptionCache, frame: AgentFrame, message: Message) -> None:
        """Record the sent message as the honest strategy does."""
        self._honest.record_sent(cache, frame, message)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Fuse as the honest strategy does."""
        return self._honest.fuse(cache, frame, messages)
