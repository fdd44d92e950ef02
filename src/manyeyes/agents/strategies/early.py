# SPDX-License-Identifier: Apache-2.0
"""Early fusion: every agent sends its points; the ego runs the detector on the merged cloud. An upper bound at a high bandwidth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import ego_from_sender, make_header
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud


@dataclass(frozen=True)
class EarlyFusion:
    """The points of every agent's last two sweeps, quantised by the wire to a centimetre."""

    name: str = "early"
    uses_history: bool = False

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """A message with the agent's whole cloud."""
        return replace(make_header(frame, cache.detector.fingerprint), points=frame.points)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the merged cloud and of the one merged before it."""
        received = [m.points.transform(ego_from_sender(frame, m)) for m in messages if m.points is not None]
        merged = PointCloud.cat([frame.points, *received])
        return cache.run_detector(merged, cache.previous_merged_cloud(frame, merged)).boxes
