# SPDX-License-Identifier: Apache-2.0
"""No fusion: the ego neither sends nor fuses messages. The lower bound of every comparison."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import FusionStrategy, register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message


@register_strategy("no-fusion")
class NoFusion(FusionStrategy):
    """Single-agent perception without messages."""

    uses_points = False
    waits_for_messages = False

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """None, since nothing is sent."""
        return None

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the agent's own cloud."""
        return cache.process(frame).boxes
