# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's second stage as its text reads (CrowdMap 2.3): gate, register element by element, keep the best.

The paper states: two elements overlap where their Chamfer distance is below a threshold; overlapping ones are registered by
rigid CPD onto the most confident. It gives no threshold, no parameters and no rule of merging. Interpretation here: from the
most confident element on, each takes the free elements of its class that overlap it. Those are registered onto it. One that
still does not fit within ``max_registered_chamfer_m`` stays free. Of the others the most confident stays (``keep``), or its
points become the mean of all (``mean``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import BaselineRules, Floats, Ints, MergedElement, filter_elements, to_vector_map
from manyeyes.maps.baselines.chamfer_nms import find_overlaps
from manyeyes.maps.baselines.cpd import CpdConfig, register
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion
from manyeyes.ops.polyline import project_onto_line, resample
from manyeyes.ops.polyline_distance import chamfer_distance


@dataclass(frozen=True)
class CrowdMapLiteralConfig:
    """Configuration of the baseline.

    max_overlap_chamfer_m: largest Chamfer distance of an overlap; max_registered_chamfer_m: the same after registration.
    num_samples: points per line for both. cpd: of the registration.
    merge: result of registered elements. rules: pre-filter, score and state.
    """

    max_overlap_chamfer_m: float = 1.5
    max_registered_chamfer_m: float = 1.5
    num_samples: int = 50
    cpd: CpdConfig = field(default_factory=CpdConfig)
    merge: Literal["keep", "mean"] = "keep"
    rules: BaselineRules = field(default_factory=BaselineRules)

    def __post_init__(self) -> None:
        if self.merge not in ("keep", "mean"):
            raise ConfigError(f"crowdmap_literal.merge: expected keep or mean; got {self.merge!r}. Choose one of them.")


@register_map_fusion("crowdmap-literal", CrowdMapLiteralConfig)
def fuse(
    observations: Sequence[Observation],
    config: CrowdMapLiteralConfig = CrowdMapLiteralConfig(),
    frame: MapFrame | None = None,
) -> VectorMap:
    """Return the literal pipeline's map."""
    element_pool = filter_elements(observations, config.rules)
    elements = element_pool.elements
    line = resample(*element_pool.closed_lines(), config.num_samples)[0].reshape(-1, config.num_samples, 2)
    pairs = find_overlaps(element_pool, config.max_overlap_chamfer_m, config.num_samples)
    pairs = pairs[element_pool.observation_of_element[pairs[:, 0]] != element_pool.observation_of_element[pairs[:, 1]]]
    both = np.concatenate((pairs, pairs[:, ::-1]))
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    start = np.searchsorted(both[:, 0], np.arange(len(elements) + 1))
    free = np.ones(len(elements), bool)
    merged = []
    for row in element_pool.sort_by_plausibility(np.arange(len(elements))).tolist():
        if not free[row]:
            continue
        free[row] = False
        partners = both[start[row] : start[row + 1], 1]
        partners = element_pool.sort_by_plausibility(partners[free[partners]])
        moved = np.array([register(line[row], line[k], config.cpd).apply(line[k]) for k in partners])
        fits = _fits(line[row], moved.reshape(-1, config.num_samples, 2), config.max_registered_chamfer_m)
        free[partners[fits]] = False
        shape = elements.polyline(row)
        if config.merge == "mean" and fits.any():
            shape = average_lines(line[row], moved[fits])
            shape = shape[:-1] if elements.kind[row] == CROSSING else shape
        merged.append(MergedElement(shape, int(elements.kind[row]), np.array([row, *partners[fits]])))
    return to_vector_map(element_pool, merged, config.rules, frame)


def _fits(anchor: Floats, moved: Floats, max_chamfer_m: float) -> np.ndarray:
    """Return (K,) which of the registered lines (K, S, 2) lie on the anchor (S, 2)."""
    count, samples = moved.shape[:2]
    rows: Ints = np.arange(count)
    pairs = np.stack((rows, np.zeros(count, np.int64)), 1)
    ends = np.arange(count + 1) * samples
    return chamfer_distance(moved.reshape(-1, 2), ends, anchor, np.array([0, samples]), pairs) <= max_chamfer_m


def average_lines(anchor: Floats, others: Floats) -> Floats:
    """Return (S, 2) the anchor's points, each the mean of itself and of its feet on those of the other lines (K, S, 2) that
    reach it.
    """
    total, count = anchor.copy(), np.ones(len(anchor))
    for other in others:
        near = project_onto_line(anchor, other)
        passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(other, axis=0).T))))
        foot = np.stack([np.interp(near.station_m, passed, other[:, axis]) for axis in range(2)], 1)
        whole = near.is_interior | (other[0] == other[-1]).all()
        total[whole] += foot[whole]
        count[whole] += 1
    return total / count[:, None]
