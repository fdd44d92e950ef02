# SPDX-License-Identifier: Apache-2.0
"""FeaCo's pose-error rectification: assign positions of high confidence by distance, reject outliers by the median deviation,
then ICP.

Gu et al., ACM MM 2023. Landmarks take the place of the paper's centroids of confident cells. The paper has no minimum number of
matches, so one pair gives an estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from manyeyes.pose.baselines._common import fit_pose, make_estimate, match_mutual_nearest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class FeacoConfig:
    """max_distance_m: a place without a counterpart this near is dropped (10 cells of 0.8 m). max_deviations: of the median that
    a cost may be off. num_iterations: of ICP.
    """

    max_distance_m: float = 8.0
    max_deviations: float = 1.0
    num_iterations: int = 2


@register_pose_corrector("feaco")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: FeacoConfig | None = None
) -> PoseEstimate:
    """Return the prior, corrected so that assigned positions coincide; NO_MATCH without a prior or near positions."""
    config = config or FeacoConfig()
    if prior is None or not len(ego) or not len(other):
        return no_estimate(prior)
    pose = prior.pose
    pairs = _assign(ego.xy, other.transform(pose).xy, config)
    for round_ in range(config.num_iterations):
        if round_:
            pairs = match_mutual_nearest(ego.xy, other.transform(pose).xy, config.max_distance_m / 2)
        if not len(pairs):
            return no_estimate(prior)
        i, k = pairs.T
        if len(pairs) == 1:
            # One pair gives the translation only: the yaw stays.
            pose = pose + np.array([*(ego.xy[i] - other.transform(pose).xy[k])[0], 0.0])
        else:
            pose = fit_pose(ego.xy[i], other.xy[k])
    return make_estimate(ego, other, pose, pairs, prior)


def _assign(here: np.ndarray, there: np.ndarray, config: FeacoConfig) -> np.ndarray:
    apart = np.hypot(*(here[:, None] - there[None]).transpose(2, 0, 1))
    rows, columns = (
        np.flatnonzero(apart.min(1) <= config.max_distance_m),
        np.flatnonzero(apart.min(0) <= config.max_distance_m),
    )
    if not len(rows) or not len(columns):
        return np.zeros((0, 2), np.int64)
    row, column = linear_sum_assignment(apart[np.ix_(rows, columns)])
    pairs = np.stack((rows[row], columns[column]), 1)
    cost = apart[pairs[:, 0], pairs[:, 1]]
    off = np.abs(cost - np.median(cost))
    return pairs[off <= config.max_deviations * max(float(np.median(off)), 1e-9)]
