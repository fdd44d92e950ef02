# SPDX-License-Identifier: Apache-2.0
"""Boxes that were seen or said a moment ago take part too: where they should be by now, a little less sure of themselves.

What tokens of the instants before do for intermediate fusion, their boxes do for late fusion that remembers: its strongest rival.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from manyeyes.agents.perception_cache import AgentOutput
from manyeyes.datatypes import AgentFrame, Boxes
from manyeyes.ops.nms import rotated_nms

SCORE_DECAY_PER_100MS = 0.95
"""What a tenth of a second leaves of a score; chosen on Town07 for late fusion."""
DUPLICATE_IOU = 0.15
"""Boxes that overlap more are one object."""


def decay_scores(boxes: Boxes, seconds: float) -> Boxes:
    """The same boxes, as sure as so many seconds leave them."""
    return replace(boxes, score=boxes.score * SCORE_DECAY_PER_100MS ** (10 * seconds))


def propagate_boxes(frame: AgentFrame, outputs: Iterable[tuple[AgentFrame, AgentOutput]]) -> list[Boxes]:
    """The boxes of an agent's views before this frame, in it, each where its velocity has taken it."""
    found = []
    for before, output in outputs:
        seconds = (frame.timestamp_ns - before.timestamp_ns) / 1e9
        boxes = output.boxes.after(seconds).transform(frame.now_from_earlier(before))
        found.append(decay_scores(boxes.to(frame.points.xyz.dtype), seconds))
    return found


def merge_boxes_nms(boxes: list[Boxes], iou: float = DUPLICATE_IOU) -> Boxes:
    """All boxes, best first, without those that overlap a better one."""
    all_of_them = Boxes.cat(boxes)
    return all_of_them[rotated_nms(all_of_them.bev().double(), all_of_them.score, iou, max_candidates=len(all_of_them))]
