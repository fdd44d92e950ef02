# SPDX-License-Identifier: Apache-2.0
"""Matching without poses: objects matched by their descriptors alone, without geometry between matches and without a prior.

Stands for MASH (Glaser et al., IROS 2021), which fills a cost volume between all cells of two agents' features and takes the
best cell for each. Without learned weights, an object's descriptor is its size and the distances to its nearest neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import fit_pose, make_estimate
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class MashConfig:
    """num_neighbours: distances in a descriptor; size_scale_m, distance_scale_m: differences of unit cost; min_pairs: pairs that
    an estimate needs.
    """

    num_neighbours: int = 4
    size_scale_m: float = 0.3
    distance_scale_m: float = 1.0
    min_pairs: int = 3


@register_pose_corrector("mash")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: MashConfig | None = None
) -> PoseEstimate:
    """Return the pose of objects that are mutual best matches in the cost volume; the prior is not used."""
    config = config or MashConfig()
    if min(len(ego), len(other)) <= config.num_neighbours:
        return no_estimate(prior)
    cost = np.square(_descriptors(ego, config)[:, None] - _descriptors(other, config)[None]).sum(-1)
    best = cost.argmin(1)
    rows = np.flatnonzero(cost.argmin(0)[best] == np.arange(len(ego)))
    pairs = np.stack((rows, best[rows]), 1)
    if len(pairs) < config.min_pairs:
        return no_estimate(prior)
    pose = fit_pose(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]])
    return make_estimate(ego, other, pose, pairs, prior)


def _descriptors(x: Landmarks, config: MashConfig) -> np.ndarray:
    """Return (N, 2 + num_neighbours) scaled descriptors."""
    apart = np.sort(np.hypot(*(x.xy[:, None] - x.xy[None]).transpose(2, 0, 1)), 1)[:, 1 : config.num_neighbours + 1]
    return np.column_stack((x.size / config.size_scale_m, apart / config.distance_scale_m))
