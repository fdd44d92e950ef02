# SPDX-License-Identifier: Apache-2.0
"""Ways to collaborate: what an agent says, and what it makes of what it hears. One a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from manyeyes.agents.perception_cache import REMEMBERED, Eyes
from manyeyes.agents.strategies.early import Early
from manyeyes.agents.strategies.intermediate import Intermediate, at_random, confidence, learned
from manyeyes.agents.strategies.late import Late
from manyeyes.agents.strategies.multi_hop import Fused
from manyeyes.agents.strategies.no_fusion import Alone
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message

__all__ = ["METHODS", "Alone", "Collaboration", "Early", "Intermediate", "Late", "method"]


class Collaboration(Protocol):
    """The two halves of one way to collaborate."""

    @property
    def name(self) -> str:
        """How tables call it."""
        ...

    @property
    def remembers(self) -> bool:
        """Whether it also hears what was said a moment ago: older messages, and the last of those who fell silent."""
        ...

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """The message of this frame, before selection and encoding; None says nothing."""
        ...

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes in the agent's frame, from its own cloud and what the others said."""
        ...


METHODS: dict[str, Collaboration] = {
    m.name: m
    for m in (
        Alone(),
        Late(),
        Late("late-remembering", instants=REMEMBERED),
        Intermediate(),
        Intermediate("learned", learned),
        Intermediate("confidence", confidence),
        Intermediate("random", at_random),
        Fused(),
        Early(),
    )
}


def method(name: str) -> Collaboration:
    """The method of that name."""
    if name not in METHODS:
        raise ConfigError(f"There is no method {name!r}; known are {', '.join(METHODS)}.")
    return METHODS[name]
