# SPDX-License-Identifier: Apache-2.0
"""Ego alone: says nothing, hears nothing. The floor of every comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class NoFusion:
    """No collaboration."""

    name: str = "none"
    uses_history: bool = False

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """Nothing."""
        return None

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """What the agent's own cloud shows."""
        return cache.process(frame).boxes
