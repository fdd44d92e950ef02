# SPDX-License-Identifier: Apache-2.0
"""The ego in the result of a fusion: no received content removes its own detections, and its own vehicle is no result."""

from __future__ import annotations

from dataclasses import replace

import torch

from manyeyes.agents._distance_kernels import has_neighbour
from manyeyes.datatypes import AgentFrame, Boxes

SAME_OBJECT_DISTANCE_M = 1.0
"""Maximum distance between the centres of an own box and the box that replaces it."""
DISPLACED_SCORE_FACTOR = 0.5
"""Factor on the score of an own box that no box of the result replaces."""
MIN_RESTORED_SCORE = 0.3
"""Minimum score of an own box that is restored after learned fusion."""

UNKNOWN_BODY_HALF_SIZE_M = (2.6, 1.3)
"""Half length and half width of the area around the origin in which boxes are the ego, where its body is unknown."""
BODY_MARGIN_M = 0.35
"""Maximum distance of the centre of a box of the ego from its known body."""


def restore_own_boxes(fused: Boxes, own: Boxes, min_score: float = MIN_RESTORED_SCORE) -> Boxes:
    """Return the fused boxes, and each own box of min_score without a fused box nearby, at a reduced score; by falling score."""
    mine, theirs = (boxes.center.float().contiguous().numpy() for boxes in (own, fused))
    replaced = torch.from_numpy(has_neighbour(mine, theirs, SAME_OBJECT_DISTANCE_M))
    displaced = (own.score >= min_score) & ~replaced
    if not displaced.any():
        return fused
    restored = replace(own, score=own.score * DISPLACED_SCORE_FACTOR)[displaced].to(fused.center.dtype)
    found = Boxes.cat([fused, restored])
    return found[found.score.argsort(descending=True, stable=True)]


def remove_own_body(boxes: Boxes, frame: AgentFrame) -> Boxes:
    """Return the boxes, in the frame of an agent, without its own vehicle, which other agents detect."""
    if frame.is_infrastructure:
        return boxes
    if frame.body is not None:
        return boxes[~frame.body.contains_xy(boxes.center[:, :2], BODY_MARGIN_M)]
    half_length, half_width = UNKNOWN_BODY_HALF_SIZE_M
    return boxes[(boxes.center[:, 0].abs() > half_length) | (boxes.center[:, 1].abs() > half_width)]
