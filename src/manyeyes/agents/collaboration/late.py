# SPDX-License-Identifier: Apache-2.0
"""Late fusion: every agent sends its boxes; the ego keeps the best of those that overlap (detection.md A.9).

What others send is bounded before it is ranked, and no box of another agent removes an object that the ego detects itself: it may
replace the ego's box only by one at the same place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.collaboration.fading import SAME_IOU, faded, moved, strongest
from manyeyes.agents.collaboration.heading import age_s, behind_s, ego_from_sender, header
from manyeyes.agents.eyes import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.ops.box_iou import pairwise_iou

SAME_PLACE_M = 1.0
"""A box of another agent replaces an overlapping one of the ego's own where their centres are no farther apart."""


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
        own = strongest([eyes.see(frame).boxes], self.nms_iou)
        others = [Boxes.empty(own.center.dtype)]
        for m, behind in zip(messages, behind_s(messages)):
            if m.objects is not None:
                there = m.objects.after(age_s(frame, m)).transform(ego_from_sender(frame, m))
                near = there[eyes.grid.inside(there.center[:, :2])]
                best = near[near.score.argsort(descending=True, stable=True)[: self.max_boxes]]
                others.append(faded(best.to(own.center.dtype), behind))
        agreeing = _without_conflicts(Boxes.cat(others), own, self.nms_iou)
        return strongest([own, *moved(frame, eyes.before(frame, self.instants)), agreeing], self.nms_iou)


def _without_conflicts(others: Boxes, own: Boxes, iou: float) -> Boxes:
    """Drop boxes of others that overlap an own one but stand elsewhere: suppression would take the own one away for them."""
    overlaps = pairwise_iou(others.bev().double(), own.bev().double()) > iou
    elsewhere = torch.cdist(others.center[:, :2], own.center[:, :2]) > SAME_PLACE_M
    return others[~(overlaps & elsewhere).any(1)]
