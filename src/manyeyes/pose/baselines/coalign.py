# SPDX-License-Identifier: Apache-2.0
"""CoAlign's agent-object pose graph: boxes that the prior pose brings together are one object, and all poses are optimized.

Lu et al., ICRA 2023, section on agent-object pose graph optimisation. The information of an edge is that of the detector's
stated errors in metres, instead of the paper's exp(-s) over the anchor's diagonal. A cluster holds one box of each agent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from manyeyes.ops.se2 import PoseGraphEdges, solve_pose_graph
from manyeyes.pose.baselines._common import make_estimate, match_mutual_nearest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class CoalignConfig:
    """max_distance_m: boxes nearer than this are one object. min_objects: so many objects or fewer give no graph.
    max_yaw_variance_rad2: objects whose headings vary by more are left out; where these are half of all, there is no estimate.
    """

    max_distance_m: float = 1.5
    min_objects: int = 3
    max_yaw_variance_rad2: float = 0.2


@register_pose_corrector("coalign")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: CoalignConfig | None = None
) -> PoseEstimate:
    """Return the other's pose in the optimized graph; NO_MATCH without a prior or with too few objects."""
    config = config or CoalignConfig()
    if prior is None:
        return no_estimate(None)
    pairs = match_mutual_nearest(ego.xy, other.transform(prior.pose).xy, config.max_distance_m)
    i, k = pairs.T
    turn = ego.yaw[i] - other.yaw[k] - prior.pose[2]
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    hard = turn**2 / 4 > config.max_yaw_variance_rad2
    if len(pairs) <= config.min_objects or 2 * hard.sum() >= len(pairs):
        return no_estimate(prior)
    pairs = pairs[~hard]
    poses = optimize_pose_graph(ego, other, pairs, prior, turn[~hard])
    return make_estimate(ego, other, poses[1].numpy(), pairs, prior)


def optimize_pose_graph(
    ego: Landmarks, other: Landmarks, pairs: np.ndarray, prior: PosePrior, turn: np.ndarray
) -> Tensor:
    """Return poses (2 + P, 3) of ego, other and objects, in the ego's frame; turn (P,): headings' difference modulo pi."""
    i, k = pairs.T
    n = len(pairs)
    ego_measured = torch.from_numpy(np.column_stack((ego.xy[i], ego.yaw[i])))
    # The other's heading is taken as the one nearer to the ego's, so that a box turned by pi is the same object.
    other_measured = torch.from_numpy(np.column_stack((other.xy[k], ego.yaw[i] - prior.pose[2] - turn)))
    start = torch.cat((torch.zeros(1, 3, dtype=torch.float64), torch.from_numpy(prior.pose)[None], ego_measured))
    objects = torch.arange(n) + 2
    sigma = np.concatenate(
        [np.column_stack((s.sigma_xy[r], s.sigma_xy[r], s.sigma_yaw[r])) for s, r in ((ego, i), (other, k))]
    )
    edges = PoseGraphEdges(
        torch.cat((torch.zeros(n, dtype=torch.int64), torch.ones(n, dtype=torch.int64))),
        torch.cat((objects, objects)),
        torch.cat((ego_measured, other_measured)),
        torch.from_numpy(sigma**-2.0).diag_embed(),
    )
    return solve_pose_graph(start, edges, torch.arange(n + 2) == 0).poses
