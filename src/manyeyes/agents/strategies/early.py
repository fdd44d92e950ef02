# SPDX-License-Identifier: Apache-2.0
"""Early fusion: every agent sends its points; the ego runs the detector on the merged cloud. An upper bound at a high bandwidth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import ego_from_sender, make_header
from manyeyes.agents.strategies.registry import FusionStrategy, register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud


@register_strategy("early")
class EarlyFusion(FusionStrategy):
    """The points of every agent's last two sweeps, quantised by the wire to a centimetre."""

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return a message with the agent's whole cloud."""
        return replace(make_header(frame, cache.detector.fingerprint), points=frame.points)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the merged cloud and of the one merged before it."""
        received = [m.points.transform(ego_from_sender(frame, m)) for m in messages if m.points is not None]
        merged = PointCloud.cat([frame.points, *received])
        return cache.run_detector(merged, cache.previous_merged_cloud(frame, merged)).boxes
