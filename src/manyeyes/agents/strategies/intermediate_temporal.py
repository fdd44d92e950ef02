# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion with memory, the default of agents: also the tokens of the last two frames, own and received ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from torch import Tensor

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import (
    IntermediateFusion,
    confidence_score,
    gather_tokens,
    mask_score,
    random_score,
)
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.agents.token_codec import has_token_history
from manyeyes.datatypes import AgentFrame, Message
from manyeyes.models.fusion.transform_tokens import Tokens, to_ego_frame


@register_strategy("intermediate-temporal")
@dataclass(frozen=True)
class TemporalIntermediateFusion(IntermediateFusion):
    """Fusion of the tokens of three frames. score: order in which a budget keeps tokens; receivers have earlier ones."""

    score: Callable[[PerceptionCache, AgentFrame], Tensor] = novelty_score
    uses_history: bool = True

    def gather(
        self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]
    ) -> tuple[Tokens, Tokens | None]:
        """Return the tokens of messages and of the agent's last three frames; and its past ones alone."""
        return gather_ego_tokens(cache, frame, messages)


register_strategy("intermediate-mi-temporal")(partial(TemporalIntermediateFusion, mask_score))
register_strategy("intermediate-confidence-temporal")(partial(TemporalIntermediateFusion, confidence_score))
register_strategy("intermediate-random-temporal")(partial(TemporalIntermediateFusion, random_score))


def gather_ego_tokens(
    cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]
) -> tuple[Tokens, Tokens | None]:
    """Return the ego's current and past tokens with those of every message on the same lattice; and its own past tokens alone."""
    grid = cache.process_tokens(frame).shared_tokens.grid
    past = cache.previous_tokens(frame) if has_token_history(cache.detector) else []
    return gather_tokens(cache, frame, messages, past), to_ego_frame(past, grid, 1) if past else None
