# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion whose ego estimates the pose error of each sender from its tokens (``models.fusion.sender_shift``).

Messages are those of ``intermediate``. It works with any weights, beside or without a pose corrector: a corrector needs a track
of a sender and reports unusable poses, the shift is estimated from one message.
"""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.agents.strategies.redundancy import novelty_score
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, Message
from manyeyes.models.fusion.sender_shift import align_senders
from manyeyes.models.fusion.transform_tokens import Tokens


@register_strategy("intermediate-shift")
class ShiftedFusion(IntermediateFusion):
    """Fusion of tokens that are moved by the estimated shift of their sender; a bare fusion has no centres to estimate it from."""

    def gather(
        self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]
    ) -> tuple[Tokens, Tokens | None]:
        """Return the tokens that are fused, those of senders moved, and the ego's own past ones among them, if any."""
        tokens, past = super().gather(cache, frame, messages)
        return align_senders(tokens, past), past


@register_strategy("intermediate-shift-temporal")
def _with_memory() -> ShiftedFusion:
    return ShiftedFusion(novelty_score, uses_history=True)
