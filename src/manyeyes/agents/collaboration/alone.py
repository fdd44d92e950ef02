# SPDX-License-Identifier: Apache-2.0
"""Ego alone: says nothing, hears nothing. The floor of every comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.agents.collaboration.fading import moved, strongest
from manyeyes.agents.eyes import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class Alone:
    """No collaboration."""

    name: str = "alone"

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """Nothing."""
        return None

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """What the agent's own clouds show, of now and of a moment ago."""
        return strongest([eyes.see(frame).boxes, *moved(frame, eyes.before(frame))])
