# SPDX-License-Identifier: Apache-2.0
"""CrowdMap's second stage as its text reads (CrowdMap 2.3, specs/maps.md 3.1): gate, register element by element, keep the best.

The paper says: two elements overlap where their Chamfer distance is below a threshold; overlapping ones are registered by
rigid CPD onto the most confident. It gives no threshold, no parameters and no rule of merging. Read here: from the most
confident element on, each takes the free elements of its class that overlap it; those are registered onto it; one that still
does not fit within ``accept_m`` of Chamfer was no overlap and stays free; of the others the most confident stays (``keep``), or
its points become the mean of all (``mean``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import CROSSING
from manyeyes.maps.baselines._common import Floats, Ints, Merged, Rules, as_map, pool
from manyeyes.maps.baselines.chamfer_nms import overlaps
from manyeyes.maps.baselines.cpd import CpdConfig, register
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.ops.polyline import feet, resample
from manyeyes.ops.polyline_distance import chamfer


@dataclass(frozen=True)
class Config:
    """gate_m: Chamfer distance of an overlap before, accept_m: after registration. samples: points a line for both.

    cpd: settings of the registration. merge: what becomes of registered elements. rules: pre-filter, score and state.
    """

    gate_m: float = 1.5
    accept_m: float = 1.5
    samples: int = 50
    cpd: CpdConfig = field(default_factory=CpdConfig)
    merge: Literal["keep", "mean"] = "keep"
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        if self.merge not in ("keep", "mean"):
            raise ConfigError(f"crowdmap_literal.merge: expected keep or mean; got {self.merge!r}. Choose one of them.")


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The literal pipeline's map."""
    seen = pool(observations, config.rules)
    elements = seen.elements
    line = resample(*seen.lines(), config.samples)[0].reshape(-1, config.samples, 2)
    pairs = overlaps(seen, config.gate_m, config.samples)
    pairs = pairs[seen.observation[pairs[:, 0]] != seen.observation[pairs[:, 1]]]
    both = np.concatenate((pairs, pairs[:, ::-1]))
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    start = np.searchsorted(both[:, 0], np.arange(len(elements) + 1))
    free = np.ones(len(elements), bool)
    merged = []
    for row in seen.order(np.arange(len(elements))).tolist():
        if not free[row]:
            continue
        free[row] = False
        partners = both[start[row] : start[row + 1], 1]
        partners = seen.order(partners[free[partners]])
        moved = np.array([register(line[row], line[k], config.cpd).apply(line[k]) for k in partners])
        fits = _fits(line[row], moved.reshape(-1, config.samples, 2), config.accept_m)
        free[partners[fits]] = False
        shape = elements.polyline(row)
        if config.merge == "mean" and fits.any():
            shape = mean_line(line[row], moved[fits])
            shape = shape[:-1] if elements.kind[row] == CROSSING else shape
        merged.append(Merged(shape, int(elements.kind[row]), np.array([row, *partners[fits]])))
    return as_map(seen, merged, config.rules, frame)


def _fits(anchor: Floats, moved: Floats, accept_m: float) -> np.ndarray:
    """(K,) which of the registered lines (K, S, 2) lie on the anchor (S, 2)."""
    count, samples = moved.shape[:2]
    rows: Ints = np.arange(count)
    pairs = np.stack((rows, np.zeros(count, np.int64)), 1)
    ends = np.arange(count + 1) * samples
    return chamfer(moved.reshape(-1, 2), ends, anchor, np.array([0, samples]), pairs) <= accept_m


def mean_line(anchor: Floats, others: Floats) -> Floats:
    """(S, 2) the anchor's points, each the mean of itself and of its feet on those of the other lines (K, S, 2) that reach it."""
    total, count = anchor.copy(), np.ones(len(anchor))
    for other in others:
        near = feet(anchor, other)
        passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(other, axis=0).T))))
        foot = np.stack([np.interp(near.along, passed, other[:, axis]) for axis in range(2)], 1)
        whole = near.inside | (other[0] == other[-1]).all()
        total[whole] += foot[whole]
        count[whole] += 1
    return total / count[:, None]
