# SPDX-License-Identifier: Apache-2.0
"""No fusion with memory: the ego alone with the memory that fusion methods have. The lower bound of the temporal form."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.no_fusion import NoFusion
from manyeyes.agents.strategies.own_history import fuse_own_history
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message


@register_strategy("no-fusion-temporal")
class TemporalNoFusion(NoFusion):
    """Single-agent perception over the last frames, without messages."""

    score_form = "fused"

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the agent's own last frames."""
        return fuse_own_history(cache, frame)
