# SPDX-License-Identifier: Apache-2.0
"""FPV-RCNN's maximum consensus: poses on a grid around the prior, and the one under which most landmarks coincide.

Yuan, Cheng, Sester, IEEE RA-L 7(2), 2022. Landmarks here are vehicles only, which count twice. The distance of an accurate match
is not published; half the distance of a match is taken.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import fit_pose, make_estimate, match_mutual_nearest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class FpvRcnnConfig:
    """The grid: search_m by step_m in x and y, search_deg by step_deg in yaw. match_distance_m, accurate_distance_m: limits of a
    match and of an accurate match. vehicle_weight: score of a vehicle. min_score, min_accurate: an estimate needs that score,
    and more accurate matches than that.
    """

    search_m: float = 1.0
    step_m: float = 0.5
    search_deg: float = 3.0
    step_deg: float = 1.0
    match_distance_m: float = 1.0
    accurate_distance_m: float = 0.5
    vehicle_weight: float = 2.0
    min_score: float = 10.0
    min_accurate: int = 2


@register_pose_corrector("fpv-rcnn")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: FpvRcnnConfig | None = None
) -> PoseEstimate:
    """Return the grid's best pose, fitted to its accurate matches; NO_MATCH without a prior or enough of them."""
    config = config or FpvRcnnConfig()
    if prior is None or not len(ego) or not len(other):
        return no_estimate(prior)
    steps = [_steps(config.search_m, config.step_m)] * 2 + [np.radians(_steps(config.search_deg, config.step_deg))]
    best, best_distance, pose = -1.0, np.inf, prior.pose
    for offset in itertools.product(*steps):
        moved = prior.pose + np.array(offset)
        apart = np.hypot(*(ego.xy[:, None] - other.transform(moved).xy[None]).transpose(2, 0, 1)).min(0)
        met = apart <= config.match_distance_m
        score, distance = config.vehicle_weight * met.sum(), float(apart[met].sum())
        if (score, -distance) > (best, -best_distance):
            best, best_distance, pose = score, distance, moved
    pairs = match_mutual_nearest(ego.xy, other.transform(pose).xy, config.accurate_distance_m)
    if best < config.min_score or len(pairs) <= config.min_accurate:
        return no_estimate(prior)
    fitted = fit_pose(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]])
    return make_estimate(ego, other, fitted, pairs, prior)


def _steps(reach: float, step: float) -> np.ndarray:
    """From -reach to reach."""
    count = round(reach / step)
    return np.arange(-count, count + 1) * step
