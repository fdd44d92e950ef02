# SPDX-License-Identifier: Apache-2.0
"""Ego alone: says nothing, hears nothing. The floor of every comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.agents.perception_cache import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class Alone:
    """No collaboration."""

    name: str = "alone"
    remembers: bool = False

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """Nothing."""
        return None

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """What the agent's own cloud shows."""
        return eyes.see(frame).boxes
