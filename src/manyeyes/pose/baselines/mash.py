# SPDX-License-Identifier: Apache-2.0
"""The pose-free floor: objects matched by how they look alone, without geometry between matches and without any pose.

Stands for MASH (Glaser et al., IROS 2021; specs/pose.md 2.8), which fills a cost volume between all places of two
agents' features and takes the best place for each. What an object looks like is, without learned weights, its size
and the distances to its nearest neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manyeyes.pose.baselines._common import fit_pose, make_estimate
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class MashConfig:
    """num_neighbours: how many distances describe an object; size_scale_m, distance_scale_m: differences that cost one; min_pairs:
    pairs that an answer needs.
    """

    num_neighbours: int = 4
    size_scale_m: float = 0.3
    distance_scale_m: float = 1.0
    min_pairs: int = 3


def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: MashConfig | None = None
) -> PoseEstimate:
    """The pose that objects give which are each other's best in the cost volume; the claim has no part in it."""
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
    """(N, 2 + neighbours)."""
    apart = np.sort(np.hypot(*(x.xy[:, None] - x.xy[None]).transpose(2, 0, 1)), 1)[:, 1 : config.num_neighbours + 1]
    return np.column_stack((x.size / config.size_scale_m, apart / config.distance_scale_m))
