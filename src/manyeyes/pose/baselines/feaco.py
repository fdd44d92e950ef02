# SPDX-License-Identifier: Apache-2.0
"""FeaCo's pose-error rectification: places of high confidence, assigned by distance, outliers cut by their median
deviation, then ICP.

Gu et al., ACM MM 2023; specs/pose.md 2.3. The paper's centroids of confident cells are the landmarks here. It has no
least number of matches, so one pair is an answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manyeyes.ops.assignment import assign
from manyeyes.pose.baselines._common import answered, nearest, pose_of
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseClaim, PoseEstimate, unanswered


@dataclass(frozen=True)
class FeacoConfig:
    """reach_m: a place without a counterpart this near is dropped (10 cells of 0.8 m). deviations: of the median that
    a cost may be off. rounds: of ICP.
    """

    reach_m: float = 8.0
    deviations: float = 1.0
    rounds: int = 2


def correct(
    ego: Landmarks, other: Landmarks, claimed: PoseClaim | None, config: FeacoConfig | None = None
) -> PoseEstimate:
    """The claim, moved so that assigned places meet; NO_MATCH where nothing is near or nothing is claimed."""
    config = config or FeacoConfig()
    if claimed is None or not len(ego) or not len(other):
        return unanswered(claimed)
    pose = claimed.pose
    pairs = _assigned(ego.xy, other.moved(pose).xy, config)
    for round_ in range(config.rounds):
        if round_:
            pairs = nearest(ego.xy, other.moved(pose).xy, config.reach_m / 2)
        if not len(pairs):
            return unanswered(claimed)
        i, k = pairs.T
        if len(pairs) == 1:
            # One place says where, not which way: the yaw stays.
            pose = pose + np.array([*(ego.xy[i] - other.moved(pose).xy[k])[0], 0.0])
        else:
            pose = pose_of(ego.xy[i], other.xy[k])
    return answered(ego, other, pose, pairs, claimed)


def _assigned(here: np.ndarray, there: np.ndarray, config: FeacoConfig) -> np.ndarray:
    apart = np.hypot(*(here[:, None] - there[None]).transpose(2, 0, 1))
    rows, columns = np.flatnonzero(apart.min(1) <= config.reach_m), np.flatnonzero(apart.min(0) <= config.reach_m)
    if not len(rows) or not len(columns):
        return np.zeros((0, 2), np.int64)
    pairs = assign(apart[np.ix_(rows, columns)])
    pairs = np.stack((rows[pairs[:, 0]], columns[pairs[:, 1]]), 1)
    cost = apart[pairs[:, 0], pairs[:, 1]]
    off = np.abs(cost - np.median(cost))
    return pairs[off <= config.deviations * max(float(np.median(off)), 1e-9)]
