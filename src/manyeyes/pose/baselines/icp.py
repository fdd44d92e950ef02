# SPDX-License-Identifier: Apache-2.0
"""Iterated closest point on landmarks, from the claimed pose. Besl and McKay, IEEE TPAMI 14(2), 1992; specs/pose.md
2.9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import answered, nearest, pose_of
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim, PoseEstimate, difference, unanswered


@dataclass(frozen=True)
class IcpConfig:
    """reach_m: how far apart a pair may be; least: pairs that a fit needs; rounds: at most so many."""

    reach_m: float = 3.0
    least: int = 3
    rounds: int = 30


def correct(
    ego: Landmarks, other: Landmarks, claimed: PoseClaim | None, config: IcpConfig | None = None
) -> PoseEstimate:
    """Where closest pairs and their fit no longer change; NO_MATCH without a claim or enough pairs."""
    config = config or IcpConfig()
    if claimed is None:
        return unanswered(None)
    pose, pairs = claimed.pose, np.zeros((0, 2), np.int64)
    for _ in range(config.rounds):
        pairs = nearest(ego.xy, other.moved(pose).xy, config.reach_m)
        if len(pairs) < config.least:
            return unanswered(claimed)
        moved = pose_of(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]])
        still = np.abs(difference(moved, pose)).max() < 1e-9
        pose = moved
        if still:
            break
    return answered(ego, other, pose, pairs, claimed)
