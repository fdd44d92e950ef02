# SPDX-License-Identifier: Apache-2.0
"""No fusion: the ego neither sends nor fuses messages. The lower bound of every comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class NoFusion:
    """Single-agent perception without messages."""

    name: str = "none"
    uses_history: bool = False

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """None, since nothing is sent."""
        return None

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the agent's own cloud."""
        return cache.process(frame).boxes
