# SPDX-License-Identifier: Apache-2.0
"""Non-maximum suppression by Chamfer distance: of elements of one kind that lie on each other, the best score stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.maps.baselines._common import Ints, Merged, Pool, Rules, as_map, pool
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.ops.polyline import near_pairs, resample
from manyeyes.ops.polyline_distance import chamfer


@dataclass(frozen=True)
class Config:
    """gate_m: Chamfer distance within which two elements are one. samples: points a line. rules: pre-filter, score and state."""

    gate_m: float = 1.0
    samples: int = 50
    rules: Rules = field(default_factory=Rules)


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The best of each heap of elements."""
    seen = pool(observations, config.rules)
    groups = heaps(seen, overlaps(seen, config.gate_m, config.samples))
    merged = [Merged(seen.elements.polyline(g[0]), int(seen.elements.kind[g[0]]), np.array(g)) for g in groups]
    return as_map(seen, merged, config.rules, frame)


def overlaps(of: Pool, gate_m: float, samples: int) -> Ints:
    """(K, 2) pairs of elements of one kind whose Chamfer distance is within the gate."""
    # No Chamfer distance is below the gap between two boxes along an axis.
    pairs = near_pairs(of.elements.bounds(), gate_m)
    pairs = pairs[of.elements.kind[pairs[:, 0]] == of.elements.kind[pairs[:, 1]]]
    line = resample(*of.lines(), samples)
    return pairs[chamfer(*line, *line, pairs) <= gate_m]


def heaps(of: Pool, pairs: Ints) -> list[list[int]]:
    """Groups of rows, the most plausible first: in the order of plausibility, each takes its partners that are still free."""
    both = np.concatenate((pairs, pairs[:, ::-1]))
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    start = np.searchsorted(both[:, 0], np.arange(len(of.elements) + 1))
    free = np.ones(len(of.elements), bool)
    groups = []
    for row in of.order(np.arange(len(of.elements))).tolist():
        if free[row]:
            free[row] = False
            partners = both[start[row] : start[row + 1], 1]
            taken = partners[free[partners]]
            free[taken] = False
            groups.append([row, *taken.tolist()])
    return groups
