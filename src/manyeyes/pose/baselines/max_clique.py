# SPDX-License-Identifier: Apache-2.0
"""Maximum clique: the largest set of associations of which each two are consistent, as in robust point registration.

A largest clique of the consistency graph is found exactly by branch and bound: the number of colours of a greedy colouring limits
the size of any clique (Tomita and Seki, 2003). Of two largest cliques the first found is taken, and beyond max_branches the largest
so far, so that the time is bounded. No prior is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_matrix

from manyeyes.pose.baselines._common import fit_pose, make_estimate
from manyeyes.pose.baselines._consistency import ConsistencyConfig, Ints, build_consistency_graph
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class MaxCliqueConfig:
    """consistency: of two associations. min_pairs: pairs that an estimate needs. max_branches: of the search."""

    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    min_pairs: int = 3
    max_branches: int = 20_000


@register_pose_corrector("max-clique")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: MaxCliqueConfig | None = None
) -> PoseEstimate:
    """Return the pose of the largest consistent set; NO_MATCH where it is too small. The prior is not used."""
    config = config or MaxCliqueConfig()
    rows_e, rows_o = (x.select_indices(1e4, config.consistency.max_boxes) for x in (ego, other))
    if min(len(rows_e), len(rows_o)) < config.min_pairs:
        return no_estimate(prior)
    graph = build_consistency_graph(ego[rows_e], other[rows_o], config.consistency)
    members = find_max_clique(graph.length_difference, config.max_branches)
    if len(members) < config.min_pairs:
        return no_estimate(prior)
    chosen = graph.pairs[members]
    pairs = np.stack((rows_e[chosen[:, 0]], rows_o[chosen[:, 1]]), 1)
    return make_estimate(ego, other, fit_pose(ego.xy[pairs[:, 0]], other.xy[pairs[:, 1]]), pairs, prior)


def find_max_clique(graph: csr_matrix, max_branches: int) -> Ints:
    """Return the sorted nodes of a largest clique of a symmetric graph (P, P), whose stored entries are edges."""
    count = len(graph.indptr) - 1
    # Nodes of many neighbours first: their colours are the smallest, so that the last branches are cut off early. Of equally many
    # those of small entries, so that which clique is found first does not depend on the order of the nodes.
    order = np.lexsort((np.arange(count), np.asarray(graph.sum(axis=1)).ravel(), -np.diff(graph.indptr)))
    place = np.argsort(order)
    neighbours = [sum(1 << int(place[k]) for k in graph.indices[graph.indptr[n] : graph.indptr[n + 1]]) for n in order]
    search = _CliqueSearch(neighbours, max_branches)
    search.expand([], (1 << count) - 1)
    return np.sort(order[np.array(search.best, np.int64)])


class _CliqueSearch:
    """Branch and bound; sets of nodes are bits of integers."""

    def __init__(self, neighbours: list[int], max_branches: int) -> None:
        self.neighbours, self.branches_left = neighbours, max_branches
        self.best: list[int] = []

    def expand(self, members: list[int], candidates: int) -> None:
        """Extend a clique by nodes of candidates, all of which are adjacent to its members."""
        if not candidates and len(members) > len(self.best):
            self.best = members
        for node, num_colours in reversed(self._colour(candidates)):
            if len(members) + num_colours <= len(self.best) or self.branches_left <= 0:
                return
            self.branches_left -= 1
            self.expand([*members, node], candidates & self.neighbours[node])
            candidates &= ~(1 << node)

    def _colour(self, nodes: int) -> list[tuple[int, int]]:
        """Return the nodes with the number of colours of those up to it; nodes of one colour are not adjacent."""
        out, colour = list[tuple[int, int]](), 0
        while nodes:
            colour, free = colour + 1, nodes
            while free:
                node = (free & -free).bit_length() - 1
                nodes &= ~(1 << node)
                free &= ~(1 << node) & ~self.neighbours[node]
                out.append((node, colour))
        return out
