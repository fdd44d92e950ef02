# SPDX-License-Identifier: Apache-2.0
"""Every element of every observation, nothing merged: what any fusion has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from manyeyes.maps.baselines._common import Merged, Rules, as_map, pool
from manyeyes.maps.elements.observation import Frame, Observation
from manyeyes.maps.elements.vector_map import VectorMap


@dataclass(frozen=True)
class Config:
    """rules: pre-filter, score and state."""

    rules: Rules = field(default_factory=Rules)


def fuse(observations: Sequence[Observation], config: Config = Config(), frame: Frame | None = None) -> VectorMap:
    """The union of all elements."""
    seen = pool(observations, config.rules)
    kinds = seen.elements.kind.tolist()
    merged = [Merged(seen.elements.polyline(k), kind, np.array([k])) for k, kind in enumerate(kinds)]
    return as_map(seen, merged, config.rules, frame)
