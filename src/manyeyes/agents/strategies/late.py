# SPDX-License-Identifier: Apache-2.0
"""Late fusion: every agent sends its boxes; the ego applies non-maximum suppression to all of them.

Received boxes are limited in number before suppression. No received box removes an own detection: an own box suppressed by a box at
another position is restored at half its score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from manyeyes.agents.own_detections import restore_own_boxes
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import age_s, ego_from_sender, lag_behind_newest_s, make_header
from manyeyes.agents.strategies.registry import FusionStrategy, register_strategy
from manyeyes.agents.strategies.temporal_boxes import DUPLICATE_IOU, decay_scores, merge_boxes_nms, propagate_boxes
from manyeyes.datatypes import AgentFrame, Boxes, Message


@register_strategy("late")
@dataclass(frozen=True)
class LateFusion(FusionStrategy):
    """Exchange of boxes.

    nms_iou: boxes with a larger IoU are one object; min_score: of a sent box; max_boxes: of a message, by falling score, within the
    ego's range. uses_history: the last HISTORY_FRAMES frames of the ego, and of the senders, are fused too, unlike in papers.
    """

    nms_iou: float = DUPLICATE_IOU
    min_score: float = 0.05
    max_boxes: int = 128
    uses_history: bool = False
    uses_points = False
    score_form = "late"

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Return a message with the agent's own boxes."""
        found = cache.process(frame).boxes
        return replace(make_header(frame, cache.detector.fingerprint), objects=found[found.score > self.min_score])

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return all boxes in the ego's frame, propagated by their velocity, one for each object.

        Scores of older boxes decay (``temporal_boxes``).
        """
        own, others = cache.process(frame).boxes, list[Boxes]()
        for m, lag_s in zip(messages, lag_behind_newest_s(messages)):
            if m.objects is not None:
                there = self.place(frame, m, m.objects)
                near = there[cache.detector.grid.contains(there.center[:, :2])]
                best = near[near.score.argsort(descending=True, stable=True)[: self.max_boxes]]
                others.append(decay_scores(best.to(own.center.dtype), lag_s))
        earlier = propagate_boxes(frame, cache.previous_outputs(frame)) if self.uses_history else []
        return restore_own_boxes(self.merge([own, *earlier, *others]), own, min_score=0.0)

    def place(self, frame: AgentFrame, message: Message, boxes: Boxes) -> Boxes:
        """Return boxes of a message in the ego's frame, propagated by their velocity."""
        return boxes.after(age_s(frame, message)).transform(ego_from_sender(frame, message))

    def merge(self, boxes: list[Boxes]) -> Boxes:
        """Return one box for each object, by falling score: the best one, after non-maximum suppression."""
        return merge_boxes_nms(boxes, self.nms_iou)


register_strategy("late-temporal")(partial(LateFusion, uses_history=True))
