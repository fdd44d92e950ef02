# SPDX-License-Identifier: Apache-2.0
"""Iterative closest point on landmarks, from the prior pose. Besl and McKay, IEEE TPAMI 14(2), 1992."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import fit_pose, make_estimate, match_mutual_nearest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate, pose_difference


@dataclass(frozen=True)
class IcpConfig:
    """max_correspondence_m: largest distance of a pair; min_pairs: pairs that a fit needs; max_iterations: of matching and
    fitting.
    """

    max_correspondence_m: float = 3.0
    min_pairs: int = 3
    max_iterations: int = 30


@register_pose_corrector("icp")
def correct(ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: IcpConfig | None = None) -> PoseEstimate:
    """Iterate closest pairs and their fit to convergence; NO_MATCH without a prior or enough pairs."""
    config = config or IcpConfig()
    if prior is None:
        return no_estimate(None)
    pose, pairs = prior.pose, np.zeros((0, 2), np.int64)
    for _ in range(config.max_iterations):
        pairs = match_mutual_nearest(ego.xy, other.transform(pose).xy, config.max_correspondence_m)
        if len(pairs) < config.min_pairs:
            return no_estimate(prior)
        moved = fit_pose(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]])
        still = np.abs(pose_difference(moved, pose)).max() < 1e-9
        pose = moved
        if still:
            break
    return make_estimate(ego, other, pose, pairs, prior)
