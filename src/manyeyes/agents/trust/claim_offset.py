# SPDX-License-Identifier: Apache-2.0
"""A common offset of all claims of one sender against detections of the ego: a stated pose that is wrong, by error or on purpose.

Single claims that are displaced by less than the gate of a match still count as supported; only together they show the offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from manyeyes.agents.trust._claim_offset_kernels import search_offset
from manyeyes.agents.trust.association import Floats


@dataclass(frozen=True)
class OffsetConfig:
    """Constants of the search, chosen on Town07.

    search_m: largest offset of a claim that is found. max_turn_deg, turn_step_deg: rotations about the sender that are tried.
    tolerance_m: of a claim to a detection after the offset is removed; the agreement falls to zero there. max_offset_m: mean
    displacement up to which a pose is consistent. min_pairs: claims that agree on a larger one. ratio, margin: their agreement must
    exceed ratio times the best agreement of a consistent pose plus the margin. memory_s: the finding holds for this time, unless a
    later search finds the pose consistent.
    """

    search_m: float = 6.0
    max_turn_deg: float = 6.0
    turn_step_deg: float = 1.5
    tolerance_m: float = 0.7
    max_offset_m: float = 1.2
    min_pairs: int = 5
    ratio: float = 1.3
    margin: float = 1.5
    memory_s: float = 1.0


@dataclass(frozen=True)
class ClaimOffset:
    """Agreement of claims with detections, in claims: the best of a consistent pose, and that of a larger displacement that agrees
    better, 0 without one, with its number of claims and their mean displacement, metres.
    """

    consistent: float
    displaced: float
    num_pairs: int
    metres: float

    def contradicts(self, config: OffsetConfig) -> bool | None:
        """Return whether the stated pose is contradicted; None if too few claims agree on anything."""
        if self.num_pairs >= config.min_pairs and self.displaced > config.ratio * self.consistent + config.margin:
            return True
        return False if self.consistent >= config.min_pairs / 2 else None


def find_offset(claims: Floats, detections: Floats, sender: tuple[float, float], config: OffsetConfig) -> ClaimOffset:
    """Return the offset of claims (N, 2) of a sender at a place against detections (K, 2) of the ego, all in one frame, metres."""
    if min(len(claims), len(detections)) < config.min_pairs:
        return ClaimOffset(0.0, 0.0, 0, 0.0)
    turns, limits = _make_arguments(config)
    xy, places = np.ascontiguousarray(claims), np.ascontiguousarray(detections)
    found = search_offset(xy, places, np.array(sender), turns, limits)
    return ClaimOffset(float(found[0]), float(found[1]), int(found[2]), float(found[3]))


@lru_cache(maxsize=8)
def _make_arguments(config: OffsetConfig) -> tuple[Floats, Floats]:
    """Return the turns, radians, and the limits of ``search_offset``."""
    num_steps = round(config.max_turn_deg / config.turn_step_deg)
    turns = np.radians(config.turn_step_deg) * np.arange(-num_steps, num_steps + 1)
    limits = np.array([config.search_m, config.tolerance_m, config.max_offset_m, config.ratio, config.margin])
    return turns, limits
