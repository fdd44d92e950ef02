# SPDX-License-Identifier: Apache-2.0
"""Boxes of previous frames, propagated by their velocity with decaying scores.

They give late fusion the same history that tokens of previous frames give intermediate fusion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from manyeyes.agents.perception_cache import AgentOutput
from manyeyes.datatypes import AgentFrame, Boxes
from manyeyes.ops.nms import rotated_nms

SCORE_DECAY_PER_100MS = 0.95
"""Factor on a score for each 100 ms of age; chosen on Town07 for late fusion."""
DUPLICATE_IOU = 0.15
"""Boxes with a larger IoU are one object."""


def decay_scores(boxes: Boxes, seconds: float) -> Boxes:
    """Return the same boxes with scores decayed by their age."""
    return replace(boxes, score=boxes.score * SCORE_DECAY_PER_100MS ** (10 * seconds))


def propagate_boxes(frame: AgentFrame, outputs: Iterable[tuple[AgentFrame, AgentOutput]]) -> list[Boxes]:
    """Return boxes of an agent's previous frames, propagated by their velocity to this frame."""
    found = []
    for before, output in outputs:
        seconds = (frame.timestamp_ns - before.timestamp_ns) / 1e9
        boxes = output.boxes.after(seconds).transform(frame.now_from_earlier(before))
        found.append(decay_scores(boxes.to(frame.points.xyz.dtype), seconds))
    return found


def merge_boxes_nms(boxes: list[Boxes], iou: float = DUPLICATE_IOU) -> Boxes:
    """Return boxes by falling score after non-maximum suppression."""
    all_of_them = Boxes.cat(boxes)
    return all_of_them[rotated_nms(all_of_them.bev().double(), all_of_them.score, iou, max_candidates=len(all_of_them))]
