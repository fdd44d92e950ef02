# SPDX-License-Identifier: Apache-2.0
"""Non-maximum suppression by Chamfer distance: of elements of one kind that lie on each other, the best score stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.maps.baselines._common import (
    BaselineRules,
    ElementPool,
    Ints,
    MergedElement,
    filter_elements,
    to_vector_map,
)
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion
from manyeyes.ops.polyline import find_near_pairs, resample
from manyeyes.ops.polyline_distance import chamfer_distance


@dataclass(frozen=True)
class ChamferNmsConfig:
    """max_chamfer_m: Chamfer distance within which two elements are one. num_samples: points a line. rules: pre-filter, score
    and state.
    """

    max_chamfer_m: float = 1.0
    num_samples: int = 50
    rules: BaselineRules = field(default_factory=BaselineRules)


@register_map_fusion("chamfer-nms", ChamferNmsConfig)
def fuse(
    observations: Sequence[Observation], config: ChamferNmsConfig = ChamferNmsConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Return the best of each heap of elements."""
    element_pool = filter_elements(observations, config.rules)
    groups = cluster_elements(element_pool, find_overlaps(element_pool, config.max_chamfer_m, config.num_samples))
    merged = [
        MergedElement(element_pool.elements.polyline(g[0]), int(element_pool.elements.kind[g[0]]), np.array(g))
        for g in groups
    ]
    return to_vector_map(element_pool, merged, config.rules, frame)


def find_overlaps(pool: ElementPool, max_chamfer_m: float, num_samples: int) -> Ints:
    """Return (K, 2) pairs of elements of one kind whose Chamfer distance is within the gate."""
    # No Chamfer distance is below the gap between two boxes along an axis.
    pairs = find_near_pairs(pool.elements.bounds(), max_chamfer_m)
    pairs = pairs[pool.elements.kind[pairs[:, 0]] == pool.elements.kind[pairs[:, 1]]]
    line = resample(*pool.closed_lines(), num_samples)
    return pairs[chamfer_distance(*line, *line, pairs) <= max_chamfer_m]


def cluster_elements(pool: ElementPool, pairs: Ints) -> list[list[int]]:
    """Groups of rows, the most plausible first: in the order of plausibility, each takes its partners that are still free."""
    both = np.concatenate((pairs, pairs[:, ::-1]))
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    start = np.searchsorted(both[:, 0], np.arange(len(pool.elements) + 1))
    free = np.ones(len(pool.elements), bool)
    groups = []
    for row in pool.sort_by_plausibility(np.arange(len(pool.elements))).tolist():
        if free[row]:
            free[row] = False
            partners = both[start[row] : start[row + 1], 1]
            taken = partners[free[partners]]
            free[taken] = False
            groups.append([row, *taken.tolist()])
    return groups
