# SPDX-License-Identifier: Apache-2.0
"""No correction: the prior is used as it is."""

from __future__ import annotations

from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, no_estimate


@register_pose_corrector("identity")
def correct(ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
    """Return the prior unchanged; NO_MATCH where there is none."""
    return no_estimate(prior, PoseStatus.NO_MATCH if prior is None else PoseStatus.OK)
