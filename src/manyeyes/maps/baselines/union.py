# SPDX-License-Identifier: Apache-2.0
"""Every element of every observation, nothing merged: what any fusion has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.maps.baselines._common import BaselineRules, MergedElement, filter_elements, to_vector_map
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.elements.vector_map import VectorMap
from manyeyes.maps.registry import register_map_fusion


@dataclass(frozen=True)
class UnionConfig:
    """rules: pre-filter, score and state."""

    rules: BaselineRules = field(default_factory=BaselineRules)


@register_map_fusion("union", UnionConfig)
def fuse(
    observations: Sequence[Observation], config: UnionConfig = UnionConfig(), frame: MapFrame | None = None
) -> VectorMap:
    """Return the union of all elements."""
    element_pool = filter_elements(observations, config.rules)
    kinds = element_pool.elements.kind.tolist()
    merged = [MergedElement(element_pool.elements.polyline(k), kind, np.array([k])) for k, kind in enumerate(kinds)]
    return to_vector_map(element_pool, merged, config.rules, frame)
