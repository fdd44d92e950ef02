# SPDX-License-Identifier: Apache-2.0
"""Late fusion: every agent sends its boxes; the ego keeps the best of those that overlap (detection.md A.9).

What others send is bounded before it is ranked, and no box of another agent removes what the ego detects itself: an own box that
gave way to a box elsewhere returns at half its score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.strategies.message_header import age_s, behind_s, ego_from_sender, header
from manyeyes.agents.strategies.temporal_boxes import SAME_IOU, faded, moved, strongest
from manyeyes.datatypes import AgentFrame, Boxes, Message

SAME_PLACE_M = 1.0
"""An own box is replaced by one whose centre is no farther away."""
RETURNED_SCORE = 0.5
"""What is left of the score of an own box that gave way to one farther away."""


@dataclass(frozen=True)
class Late:
    """nms_iou: boxes of several agents that overlap more are one object; say_above: the lowest score worth its bytes; max_boxes: so
    many of a message's boxes inside the ego's range take part, the best.

    instants: so many of the ego's own before now, and with them what is remembered of the others, take part too; 0 is late fusion
    as papers have it.
    """

    name: str = "late"
    nms_iou: float = SAME_IOU
    say_above: float = 0.05
    max_boxes: int = 128
    instants: int = 0

    @property
    def remembers(self) -> bool:
        """With the ego's own past."""
        return self.instants > 0

    def say(self, eyes: Eyes, frame: AgentFrame) -> Message | None:
        """The boxes of the agent's own sweeps."""
        found = eyes.see(frame).boxes
        return replace(header(frame, eyes.detector.fingerprint), objects=found[found.score > self.say_above])

    def hear(self, eyes: Eyes, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """All boxes in the ego's frame, each where its velocity has taken it by now, after suppression by score.

        What is remembered is a little less sure (``fading``).
        """
        own, others = eyes.see(frame).boxes, list[Boxes]()
        for m, behind in zip(messages, behind_s(messages)):
            if m.objects is not None:
                there = m.objects.after(age_s(frame, m)).transform(ego_from_sender(frame, m))
                near = there[eyes.grid.inside(there.center[:, :2])]
                best = near[near.score.argsort(descending=True, stable=True)[: self.max_boxes]]
                others.append(faded(best.to(own.center.dtype), behind))
        ranked = strongest([own, *moved(frame, eyes.before(frame, self.instants)), *others], self.nms_iou)
        return _with_own(ranked, own)


def _with_own(ranked: Boxes, own: Boxes) -> Boxes:
    """All of ranked, and the own boxes that none of them replaces, less sure: within SAME_PLACE_M of each own box is a result."""
    replaced = (torch.cdist(own.center[:, :2], ranked.center[:, :2]) <= SAME_PLACE_M).any(1)
    displaced = own[~replaced]
    found = Boxes.cat([ranked, replace(displaced, score=displaced.score * RETURNED_SCORE)])
    return found[found.score.argsort(descending=True, stable=True)] if len(displaced) else ranked
