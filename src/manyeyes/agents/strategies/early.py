# SPDX-License-Identifier: Apache-2.0
"""Early fusion: every agent sends its points; the ego runs the detector on the merged cloud. An upper bound at a high bandwidth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import ego_from_sender, make_header
from manyeyes.agents.strategies.registry import FusionStrategy, register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud

MIN_POINT_LIMIT, OWN_POINTS_FACTOR = 65_536, 4
"""Points of a message beyond the larger of MIN_POINT_LIMIT and OWN_POINTS_FACTOR times the ego's own points are thinned out."""


@register_strategy("early")
class EarlyFusion(FusionStrategy):
    """The points of every agent's last two sweeps, quantised by the wire to a centimetre."""

    score_form = "early"

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return a message with the agent's whole cloud."""
        return replace(make_header(frame, cache.detector.fingerprint), points=frame.points)

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes of the merged cloud and of the one merged before it."""
        return cache.merged.process(merge_clouds(frame, messages)).boxes


def merge_clouds(frame: AgentFrame, messages: Sequence[Message]) -> AgentFrame:
    """Return the frame with the points of all messages, moved into it."""
    limit = max(MIN_POINT_LIMIT, OWN_POINTS_FACTOR * len(frame.points))
    received = [_thin(m.points, limit).transform(ego_from_sender(frame, m)) for m in messages if m.points is not None]
    return replace(frame, points=PointCloud.cat([frame.points, *received]))


def _thin(cloud: PointCloud, max_points: int) -> PointCloud:
    """Return every n-th point of a cloud, the fewest n of at most max_points; a smaller cloud is unchanged."""
    step = -(-len(cloud) // max_points)
    return cloud if step <= 1 else cloud[torch.arange(0, len(cloud), step)]
