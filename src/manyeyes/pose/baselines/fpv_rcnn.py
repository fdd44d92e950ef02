# SPDX-License-Identifier: Apache-2.0
"""FPV-RCNN's maximum consensus: poses on a grid around the claimed one, the one under which most landmarks meet.

Yuan, Cheng, Sester, IEEE RA-L 7(2), 2022; specs/pose.md 2.2. Landmarks here are vehicles only, which count twice. The
reach of an accurate match is not published; half the reach of a match is taken.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import answered, nearest, pose_of
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim, PoseEstimate, unanswered


@dataclass(frozen=True)
class FpvRcnnConfig:
    """The grid: reach_m by step_m in x and y, reach_deg by step_deg in yaw. match_m, accurate_m: how near landmarks
    meet. weight: of a vehicle. least_score, least_accurate: an answer needs that score, and more accurate matches
    than that.
    """

    reach_m: float = 1.0
    step_m: float = 0.5
    reach_deg: float = 3.0
    step_deg: float = 1.0
    match_m: float = 1.0
    accurate_m: float = 0.5
    weight: float = 2.0
    least_score: float = 10.0
    least_accurate: int = 2


def correct(
    ego: Landmarks, other: Landmarks, claimed: PoseClaim | None, config: FpvRcnnConfig | None = None
) -> PoseEstimate:
    """The grid's best pose, fitted on its accurate matches; NO_MATCH without a claim or enough of them."""
    config = config or FpvRcnnConfig()
    if claimed is None or not len(ego) or not len(other):
        return unanswered(claimed)
    steps = [_steps(config.reach_m, config.step_m)] * 2 + [np.radians(_steps(config.reach_deg, config.step_deg))]
    best, fewest, pose = -1.0, np.inf, claimed.pose
    for offset in itertools.product(*steps):
        moved = claimed.pose + np.array(offset)
        apart = np.hypot(*(ego.xy[:, None] - other.moved(moved).xy[None]).transpose(2, 0, 1)).min(0)
        met = apart <= config.match_m
        score, distance = config.weight * met.sum(), float(apart[met].sum())
        if (score, -distance) > (best, -fewest):
            best, fewest, pose = score, distance, moved
    pairs = nearest(ego.xy, other.moved(pose).xy, config.accurate_m)
    if best < config.least_score or len(pairs) <= config.least_accurate:
        return unanswered(claimed)
    fitted = pose_of(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]])
    return answered(ego, other, fitted, pairs, claimed)


def _steps(reach: float, step: float) -> np.ndarray:
    """From -reach to reach."""
    count = round(reach / step)
    return np.arange(-count, count + 1) * step
