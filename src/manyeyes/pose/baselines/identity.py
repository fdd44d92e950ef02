# SPDX-License-Identifier: Apache-2.0
"""No correction: what is claimed is used."""

from __future__ import annotations

from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim, PoseEstimate, PoseStatus, unanswered


def correct(ego: Landmarks, other: Landmarks, claimed: PoseClaim | None) -> PoseEstimate:
    """The claim as it is; NO_MATCH where there is none."""
    return unanswered(claimed, PoseStatus.NO_MATCH if claimed is None else PoseStatus.OK)
