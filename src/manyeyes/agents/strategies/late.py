# SPDX-License-Identifier: Apache-2.0
"""Late fusion: every agent sends its boxes; the ego keeps the best of those that overlap (detection.md A.9).

What others send is bounded before it is ranked, and no box of another agent removes what the ego detects itself: an own box that
gave way to a box elsewhere returns at half its score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.message_header import age_s, ego_from_sender, lag_behind_newest_s, make_header
from manyeyes.agents.strategies.temporal_boxes import DUPLICATE_IOU, decay_scores, merge_boxes_nms, propagate_boxes
from manyeyes.datatypes import AgentFrame, Boxes, Message

DUPLICATE_DISTANCE_M = 1.0
"""An own box is replaced by one whose centre is no farther away."""
DISPLACED_SCORE_FACTOR = 0.5
"""What is left of the score of an own box that gave way to one farther away."""


@dataclass(frozen=True)
class LateFusion:
    """nms_iou: boxes of several agents that overlap more are one object; min_score: the lowest score worth its bytes; max_boxes: so
    many of a message's boxes inside the ego's range take part, the best.

    history_frames: so many of the ego's own before now, and with them what is remembered of the others, take part too; 0 is late
    fusion as papers have it.
    """

    name: str = "late"
    nms_iou: float = DUPLICATE_IOU
    min_score: float = 0.05
    max_boxes: int = 128
    history_frames: int = 0

    @property
    def uses_history(self) -> bool:
        """With the ego's own past."""
        return self.history_frames > 0

    def compose_message(self, cache: PerceptionCache, frame: AgentFrame) -> Message | None:
        """The boxes of the agent's own sweeps."""
        found = cache.process(frame).boxes
        return replace(make_header(frame, cache.detector.fingerprint), objects=found[found.score > self.min_score])

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """All boxes in the ego's frame, each where its velocity has taken it by now, after suppression by score.

        What is remembered is a little less sure (``fading``).
        """
        own, others = cache.process(frame).boxes, list[Boxes]()
        for m, lag_s in zip(messages, lag_behind_newest_s(messages)):
            if m.objects is not None:
                there = m.objects.after(age_s(frame, m)).transform(ego_from_sender(frame, m))
                near = there[cache.grid.contains(there.center[:, :2])]
                best = near[near.score.argsort(descending=True, stable=True)[: self.max_boxes]]
                others.append(decay_scores(best.to(own.center.dtype), lag_s))
        ranked = merge_boxes_nms(
            [own, *propagate_boxes(frame, cache.previous_outputs(frame, self.history_frames)), *others], self.nms_iou
        )
        return _restore_own_boxes(ranked, own)


def _restore_own_boxes(ranked: Boxes, own: Boxes) -> Boxes:
    """All of ranked, and the own boxes that none of them replaces, less sure: within SAME_PLACE_M of each own box is a result."""
    replaced = (torch.cdist(own.center[:, :2], ranked.center[:, :2]) <= DUPLICATE_DISTANCE_M).any(1)
    displaced = own[~replaced]
    found = Boxes.cat([ranked, replace(displaced, score=displaced.score * DISPLACED_SCORE_FACTOR)])
    return found[found.score.argsort(descending=True, stable=True)] if len(displaced) else ranked
