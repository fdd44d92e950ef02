# SPDX-License-Identifier: Apache-2.0
"""The ego's own detections in the result of a fusion: no received content removes them."""

from __future__ import annotations

from dataclasses import replace

import torch

from manyeyes.datatypes import Boxes

SAME_OBJECT_DISTANCE_M = 1.0
"""Maximum distance between the centres of an own box and the box that replaces it."""
DISPLACED_SCORE_FACTOR = 0.5
"""Factor on the score of an own box that no box of the result replaces."""
MIN_RESTORED_SCORE = 0.3
"""Minimum score of an own box that is restored after learned fusion."""


def restore_own_boxes(fused: Boxes, own: Boxes, min_score: float = MIN_RESTORED_SCORE) -> Boxes:
    """Return the fused boxes, and each own box of min_score without a fused box nearby, at a reduced score; by falling score."""
    distance = torch.cdist(own.center[:, :2].double(), fused.center[:, :2].double())
    displaced = (own.score >= min_score) & ~(distance <= SAME_OBJECT_DISTANCE_M).any(1)
    if not displaced.any():
        return fused
    restored = replace(own, score=own.score * DISPLACED_SCORE_FACTOR)[displaced].to(fused.center.dtype)
    found = Boxes.cat([fused, restored])
    return found[found.score.argsort(descending=True, stable=True)]
