# SPDX-License-Identifier: Apache-2.0
"""Disputed places: where observations contradict each other, no trust changes.

An attacker can place a real object that some agents observe and others do not. A defence that takes sides there is turned against
honest agents (TrustFlip, arXiv 2605.22122).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.trust.association import Floats, Rows

DISPUTE_NS = 2_000_000_000
"""A place stays disputed for this time after the last contradiction."""
DISPUTE_RADIUS_M = 2.0
MAX_PLACES = 128


@dataclass(frozen=True)
class Disputes:
    """K disputed places: xy (K, 2) metres, in the ego's frame; until_ns (K,) int64."""

    xy: Floats
    until_ns: Rows

    @classmethod
    def empty(cls) -> Disputes:
        """Return an instance without places."""
        return cls(np.zeros((0, 2)), np.zeros(0, np.int64))

    def cover(self, xy: Floats) -> NDArray[np.bool_]:
        """Return (N,) which of the positions (N, 2) are disputed."""
        distance = np.hypot(xy[:, None, 0] - self.xy[None, :, 0], xy[:, None, 1] - self.xy[None, :, 1])
        return np.asarray((distance <= DISPUTE_RADIUS_M).any(1), np.bool_)

    def move(self, rotation: Floats, shift: Floats, now_ns: int) -> Disputes:
        """Return the places in the ego's frame after its motion, rotation (2, 2) and shift (2,), without those that ended."""
        is_left = np.abs(self.until_ns - now_ns) <= DISPUTE_NS
        is_left &= self.until_ns > now_ns
        return Disputes(self.xy[is_left] @ rotation.T + shift, self.until_ns[is_left])

    def add(self, xy: Floats, now_ns: int) -> Disputes:
        """Return the places with more of them (N, 2), the last MAX_PLACES."""
        until_ns = np.full(len(xy), now_ns + DISPUTE_NS, np.int64)
        places, until_ns = np.concatenate((self.xy, xy)), np.concatenate((self.until_ns, until_ns))
        return Disputes(places[-MAX_PLACES:], until_ns[-MAX_PLACES:])
