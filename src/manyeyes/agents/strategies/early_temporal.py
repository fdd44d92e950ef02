# SPDX-License-Identifier: Apache-2.0
"""Early fusion with memory of the last merged clouds, as agents have of their own sweeps. The bound of the temporal form."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.early import EarlyFusion, merge_clouds
from manyeyes.agents.strategies.own_history import fuse_own_history
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message


@register_strategy("early-temporal")
class TemporalEarlyFusion(EarlyFusion):
    """Tokens or boxes of the merged clouds of three frames; earlier messages are part of the earlier merged clouds."""

    score_form = "fused"

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the merged cloud and of the two merged before it."""
        return fuse_own_history(cache.merged, merge_clouds(frame, messages))
