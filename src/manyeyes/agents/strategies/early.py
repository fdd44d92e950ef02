# SPDX-License-Identifier: Apache-2.0
"""Early fusion: every agent sends its points; the ego looks at them all as one cloud. The bound, at any price in bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.strategies.message_header import ego_from_sender, header
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud


@dataclass(frozen=True)
class Early:
    """The points of every agent's last two sweeps, quantised by the wire to a centimetre."""

    name: str = "early"
    remembers: bool = False

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """The whole cloud."""
        return replace(header(frame, eyes.detector.fingerprint), points=frame.points)

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Boxes of the merged cloud and of the one merged before it."""
        heard = [m.points.transform(ego_from_sender(frame, m)) for m in messages if m.points is not None]
        merged = PointCloud.cat([frame.points, *heard])
        return eyes.see_cloud(merged, eyes.earlier_merged(frame, merged)).boxes
