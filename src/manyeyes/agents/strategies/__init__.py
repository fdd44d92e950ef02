# SPDX-License-Identifier: Apache-2.0
"""Fusion strategies: how an agent composes messages and fuses received ones. One file a strategy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from manyeyes.agents.perception_cache import HISTORY_FRAMES, PerceptionCache
from manyeyes.agents.strategies.early import EarlyFusion
from manyeyes.agents.strategies.intermediate import IntermediateFusion, confidence_score, mask_score, random_score
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.agents.strategies.multi_hop import MultiHopFusion
from manyeyes.agents.strategies.no_fusion import NoFusion
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message

__all__ = [
    "STRATEGIES",
    "EarlyFusion",
    "FusionStrategy",
    "IntermediateFusion",
    "LateFusion",
    "NoFusion",
    "get_strategy",
]


class FusionStrategy(Protocol):
    """Composition and fusion of messages of one collaboration scheme."""

    @property
    def name(self) -> str:
        """Name in tables and commands."""
        ...

    @property
    def uses_history(self) -> bool:
        """Whether older messages of each sender are fused too, also of senders without a current message."""
        ...

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """The message of this frame, before selection and encoding; None sends nothing."""
        ...

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes in the agent's frame, from its own cloud and received messages."""
        ...


STRATEGIES: dict[str, FusionStrategy] = {
    m.name: m
    for m in (
        NoFusion(),
        LateFusion(),
        LateFusion("late-temporal", history_frames=HISTORY_FRAMES),
        IntermediateFusion(),
        IntermediateFusion("intermediate-mi", mask_score),
        IntermediateFusion("intermediate-confidence", confidence_score),
        IntermediateFusion("intermediate-random", random_score),
        MultiHopFusion(),
        EarlyFusion(),
    )
}


def get_strategy(name: str) -> FusionStrategy:
    """The strategy of that name; ConfigError lists the known ones."""
    if name not in STRATEGIES:
        raise ConfigError(f"There is no strategy {name!r}; known: {', '.join(STRATEGIES)}.")
    return STRATEGIES[name]
