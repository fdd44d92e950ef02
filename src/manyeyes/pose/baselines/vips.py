# SPDX-License-Identifier: Apache-2.0
"""VIPS: graph matching of objects by the principal eigenvector of their affinities.

Shi et al., MobiCom 2022. The affinity of (i, i') with itself is exp(-0.5 dsize^2) exp(-0.1 d), d the distance under the prior
pose; with (j, j') it is exp(-0.5 dlength^2) exp(-0.1 |dsin heading|). Without a prior d is left out. At most max_boxes are kept,
since the matrix has (N M)^2 entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from manyeyes.pose.baselines._common import fit_pose, make_estimate
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class VipsConfig:
    """max_boxes: at most so many per agent, those of highest score. min_weight_fraction: smallest weight of a pair over that of
    the best. min_pairs: pairs that an estimate needs. num_iterations: of the power iteration.
    """

    max_boxes: int = 25
    min_weight_fraction: float = 0.3
    min_pairs: int = 3
    num_iterations: int = 50


@register_pose_corrector("vips")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: VipsConfig | None = None
) -> PoseEstimate:
    """Return the pose from the matched objects' positions; NO_MATCH where too few match."""
    config = config or VipsConfig()
    rows_e, rows_o = ego.select_indices(1e4, config.max_boxes), other.select_indices(1e4, config.max_boxes)
    if min(len(rows_e), len(rows_o)) < config.min_pairs:
        return no_estimate(prior)
    a, b = ego[rows_e], other[rows_o]
    affinity = compute_affinities(a, b, prior)
    vector = np.full(len(affinity), len(affinity) ** -0.5)
    for _ in range(config.num_iterations):
        vector = affinity @ vector
        vector /= np.linalg.norm(vector)
    weight = vector.reshape(len(a), len(b))
    pairs = np.stack(linear_sum_assignment(-weight), 1)
    strong = weight[pairs[:, 0], pairs[:, 1]]
    pairs, strong = (
        pairs[strong >= config.min_weight_fraction * strong.max()],
        strong[strong >= config.min_weight_fraction * strong.max()],
    )
    if len(pairs) < config.min_pairs:
        return no_estimate(prior)
    pose = fit_pose(a.xy[pairs[:, 0]], b.xy[pairs[:, 1]], strong)
    return make_estimate(ego, other, pose, np.stack((rows_e[pairs[:, 0]], rows_o[pairs[:, 1]]), 1), prior)


def compute_affinities(a: Landmarks, b: Landmarks, prior: PosePrior | None) -> np.ndarray:
    """Return (N M, N M) affinities, pair (i, i') in row i M + i'; zero for two pairs that share an object."""
    n, m = len(a), len(b)
    node = np.exp(-0.5 * np.square(a.size[:, None] - b.size[None]).sum(-1))
    if prior is not None:
        node = node * np.exp(-0.1 * np.hypot(*(a.xy[:, None] - b.transform(prior.pose).xy[None]).transpose(2, 0, 1)))
    lengths = [np.hypot(*(x.xy[:, None] - x.xy[None]).transpose(2, 0, 1)) for x in (a, b)]
    turns = [np.sin(x.yaw[:, None] - x.yaw[None]) for x in (a, b)]
    # (i, i', j, j') from the two agents' own (i, j) and (i', j').
    edge = np.exp(-0.5 * np.square(lengths[0][:, None, :, None] - lengths[1][None, :, None, :]))
    edge *= np.exp(-0.1 * np.abs(turns[0][:, None, :, None] - turns[1][None, :, None, :]))
    edge[np.arange(n), :, np.arange(n)] = 0.0
    edge[:, np.arange(m), :, np.arange(m)] = 0.0
    edge = edge.reshape(n * m, n * m)
    np.fill_diagonal(edge, node.ravel())
    return edge
