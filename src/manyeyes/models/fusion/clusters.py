# SPDX-License-Identifier: Apache-2.0
"""ERMVP's compression at the sender (Zhang et al., CVPR 2024): tokens are weighted by a learned score and merged into clusters.

Clusters are those of density peaks (Du et al., 2016): centres are dense, and far from any denser token. Of the dense maps of the
paper 20 % of the cells are sampled before; pruning keeps fewer of ours, so that all tokens are clustered and a byte budget samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes.ops.voxelize import segment_sum

CLUSTER_FRACTION = 0.2
"""Number of clusters of a message, as a fraction of its tokens."""
NUM_NEIGHBOURS = 10
"""Nearest tokens over which a density is taken."""


@dataclass(frozen=True, eq=False)
class ClusteredFeatures:
    """features: (N, C) of tokens, equal within a cluster; cluster: (N,) int64; score: (N,) in (0, 1)."""

    features: Tensor
    cluster: Tensor
    score: Tensor


def cluster_by_density_peaks(rows: Tensor, num_clusters: int) -> Tensor:
    """Return the cluster (N,) int64 of rows (N, C).

    d is the Euclidean distance over the root of C, the density rho = exp(-mean of the nearest d^2), and delta the least d to a
    denser row, or the largest d of the densest one. The rows of largest rho delta are centres; others go to the nearest. Of equal
    densities the first row is the denser one. As many clusters as rows, or more, leave every row by itself.
    """
    n = len(rows)
    if num_clusters >= n:
        return torch.arange(n, device=rows.device)
    distance = torch.cdist(rows, rows, compute_mode="donot_use_mm_for_euclid_dist") / rows.shape[1] ** 0.5
    nearest = distance.topk(min(NUM_NEIGHBOURS + 1, n), largest=False).values[:, 1:]
    order = nearest.square().mean(1).sort(stable=True).indices
    rank = torch.empty_like(order).index_copy(0, order, torch.arange(n, device=rows.device))
    delta = distance.masked_fill(rank[None] >= rank[:, None], torch.inf).amin(1)
    delta[order[0]] = distance.max()
    peak = torch.exp(-nearest.square().mean(1)) * delta
    centres = peak.sort(descending=True, stable=True).indices[: max(num_clusters, 1)]
    cluster = distance[:, centres].argmin(1)
    cluster[centres] = torch.arange(len(centres), device=rows.device)
    return cluster


class ClusterCompression(nn.Module):
    """Normalise features, multiply them by a learned score, and replace each by the mean of its cluster, weighted by score."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scoring = nn.Linear(channels, 1)

    def score(self, features: Tensor) -> Tensor:
        """Return the score (N,) in (0, 1) of features (N, C)."""
        return torch.sigmoid(self.scoring(features))[:, 0]

    def forward(self, features: Tensor) -> ClusteredFeatures:
        """Compress the features (N, C) of one message; the gradient does not reach the choice of clusters."""
        score = self.score(features)
        rows = functional.layer_norm(features, features.shape[1:]) * score[:, None]
        count = max(round(CLUSTER_FRACTION * len(rows)), min(len(rows), 1))
        cluster = cluster_by_density_peaks(rows.detach(), count)
        sums = segment_sum(torch.cat((rows, torch.ones_like(rows[:, :1])), 1) * score[:, None], cluster, count)
        means = sums[:, :-1] / sums[:, -1:].clamp_min(torch.finfo(rows.dtype).tiny)
        return ClusteredFeatures(means[cluster], cluster, score)
