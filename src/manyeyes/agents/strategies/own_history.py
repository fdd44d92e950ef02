# SPDX-License-Identifier: Apache-2.0
"""What one agent makes of its own last frames alone: tokens where the detector has them, else boxes."""

from __future__ import annotations

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.intermediate import gather_with_past
from manyeyes.agents.strategies.temporal_boxes import merge_boxes_nms, propagate_boxes
from manyeyes.datatypes import AgentFrame, Boxes
from manyeyes.models.detector.protocols import has_tokens


def fuse_own_history(cache: PerceptionCache, frame: AgentFrame) -> Boxes:
    """Return boxes of a frame and of the HISTORY_FRAMES frames before it, as intermediate or late fusion without messages does."""
    if has_tokens(cache.detector):
        return cache.decode(cache.fuse(*gather_with_past(cache, frame, ()))[1])
    own = cache.process(frame).boxes
    return merge_boxes_nms([own, *propagate_boxes(frame, cache.previous_outputs(frame))])
