# SPDX-License-Identifier: Apache-2.0
"""CLIPPER: the densest clique of weighted consistent associations, by a continuous relaxation.

Lusk, Fathian and How, ICRA 2021. With the affinities M of consistent associations (1 on the diagonal) and the matrix C' of the
inconsistent ones, u' M u is maximized over unit vectors u >= 0 that put no weight on two inconsistent associations. The constraint
is a penalty d u' C' u whose factor d grows until it holds; projected gradient ascent, on the sphere, with step halving. As many of
the largest entries of u are taken as the density u' M u states. Affinities are exp(-r^2 / 2 s^2) of the difference r of two edges'
lengths. The optimum is a local one. No prior is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, identity

from manyeyes.pose.baselines._common import fit_pose, make_estimate
from manyeyes.pose.baselines._consistency import ConsistencyConfig, build_consistency_graph
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_TINY = 1e-9


@dataclass(frozen=True)
class ClipperConfig:
    """consistency: of two associations. sigma_m: of the difference of two edges' lengths. min_pairs: pairs that an estimate needs.
    num_power_steps: of the start, towards the principal eigenvector. max_penalties: times that the penalty grows; max_steps: of the
    ascent for each.
    """

    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    sigma_m: float = 0.6
    min_pairs: int = 3
    num_power_steps: int = 20
    max_penalties: int = 100
    max_steps: int = 200


@register_pose_corrector("clipper")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: ClipperConfig | None = None
) -> PoseEstimate:
    """Return the pose of the densest consistent set; NO_MATCH where it is too small. The prior is not used."""
    config = config or ClipperConfig()
    rows_e, rows_o = (x.select_indices(1e4, config.consistency.max_boxes) for x in (ego, other))
    if min(len(rows_e), len(rows_o)) < config.min_pairs:
        return no_estimate(prior)
    graph = build_consistency_graph(ego[rows_e], other[rows_o], config.consistency)
    affinity = graph.length_difference.copy()
    affinity.data = np.exp(-0.5 * np.square(affinity.data / config.sigma_m))
    members = find_densest_clique(affinity, config)
    if len(members) < config.min_pairs:
        return no_estimate(prior)
    chosen = graph.pairs[members]
    pairs = np.stack((rows_e[chosen[:, 0]], rows_o[chosen[:, 1]]), 1)
    return make_estimate(ego, other, fit_pose(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]]), pairs, prior)


def find_densest_clique(affinity: csr_matrix, config: ClipperConfig | None = None) -> Ints:
    """Return the sorted nodes of a clique of locally largest density u' M u.

    affinity: (P, P) symmetric, in (0, 1] where two nodes are consistent, without a diagonal.
    """
    config, count = config or ClipperConfig(), len(affinity.indptr) - 1
    if not affinity.nnz:
        return np.zeros(0, np.int64)
    matrix = csr_matrix(affinity + identity(count))
    is_consistent = csr_matrix((np.ones(matrix.nnz), matrix.indices, matrix.indptr), matrix.shape)
    vector = np.full(count, count**-0.5)
    for _ in range(config.num_power_steps):
        vector = _project(matrix @ vector)
    penalty = 0.0
    for _ in range(config.max_penalties):
        # C' u: the weight of what is inconsistent with each node.
        violated = vector.sum() - is_consistent @ vector
        active = (violated > _TINY) & (vector > _TINY)
        if not active.any():
            break
        penalty += float(np.mean((matrix @ vector)[active] / violated[active]))
        vector = _ascend(vector, matrix, is_consistent, penalty, config.max_steps)
    size = round(float(vector @ (matrix @ vector)))
    return np.sort(np.lexsort((np.arange(count), -vector))[: max(size, 1)])


def _ascend(vector: Floats, matrix: csr_matrix, is_consistent: csr_matrix, penalty: float, max_steps: int) -> Floats:
    """Return a local maximum of u' M u - penalty u' C' u on the nonnegative part of the sphere, from a start."""

    def half_gradient(u: Floats) -> Floats:
        return matrix @ u - penalty * (u.sum() - is_consistent @ u)

    gradient, step = half_gradient(vector), 1.0
    value = float(vector @ gradient)
    for _ in range(max_steps):
        moved = _project(vector + step * gradient)
        moved_gradient = half_gradient(moved)
        moved_value = float(moved @ moved_gradient)
        while moved_value < value and step > _TINY:
            step /= 2
            moved = _project(vector + step * gradient)
            moved_gradient = half_gradient(moved)
            moved_value = float(moved @ moved_gradient)
        if moved_value - value <= _TINY:
            return moved if moved_value >= value else vector
        vector, gradient, value, step = moved, moved_gradient, moved_value, 2 * step
    return vector


def _project(vector: Floats) -> Floats:
    """Return the nearest direction without negative entries, of length 1; unchanged where none is positive."""
    positive = np.maximum(vector, 0.0)
    length = float(np.linalg.norm(positive))
    return positive / length if length > 0 else np.abs(vector) / np.linalg.norm(vector)
