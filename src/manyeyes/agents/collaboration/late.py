# SPDX-License-Identifier: Apache-2.0
"""Late fusion: every agent sends its boxes; the ego keeps the best of those that overlap (detection.md A.9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.collaboration.fading import SAME_IOU, faded, moved, strongest
from manyeyes.agents.collaboration.heading import age_s, behind_s, ego_from_sender, header
from manyeyes.agents.eyes import Eyes
from manyeyes.datatypes import AgentFrame, Boxes, Message


@dataclass(frozen=True)
class Late:
    """nms_iou: boxes of several agents that overlap more are one object; say_above: the lowest score worth its bytes.

    instants: so many of the ego's own before now, and with them what is remembered of the others, take part too; 0 is late fusion
    as papers have it.
    """

    name: str = "late"
    nms_iou: float = SAME_IOU
    say_above: float = 0.05
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
        boxes = [eyes.see(frame).boxes, *moved(frame, eyes.before(frame, self.instants))]
        for m, behind in zip(messages, behind_s(messages)):
            if m.objects is not None:
                there = m.objects.after(age_s(frame, m)).transform(ego_from_sender(frame, m))
                boxes.append(faded(there.to(frame.points.xyz.dtype), behind))
        return strongest(boxes, self.nms_iou)
