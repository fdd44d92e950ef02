# SPDX-License-Identifier: Apache-2.0
"""Tracks of the claims of one sender: the evidence on one claimed object over the last frames.

Evidence is kept for each claimed object, not for each sender: the true claims of a sender would hide a single false one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.trust._track_kernels import add_checks, count_refuted
from manyeyes.agents.trust.association import Floats, Rows, associate
from manyeyes.agents.trust.interface import Evidence

_SUPPORTED, _DISPUTED, _REFUTED = int(Evidence.SUPPORTED), int(Evidence.DISPUTED), int(Evidence.REFUTED)
NUM_CHECKS = 5
"""Number of evidences that a track keeps, the last ones."""
NO_CHECK = -1
MAX_UNCLAIMED_NS = 1_000_000_000
"""A track that is not claimed for longer ends; until then a claim that flickers stays one track."""
GATE_M = 2.0
MAX_TRACKS = 512
"""Number of tracks of a sender; beyond it those that are not claimed now end."""


@dataclass(frozen=True)
class ClaimTracks:
    """Tracks of K claimed objects, in the ego's frame of the last update.

    xy: (K, 2) metres; velocity: (K, 2) m/s. checks: (K, NUM_CHECKS) int8 of Evidence, newest first, NO_CHECK before the first.
    score: (K,) of the last claim. claimed_ns, supported_ns, refuted_ns: (K,) times of the last claim and of evidence, 0 for never.
    """

    xy: Floats
    velocity: Floats
    checks: NDArray[np.int8]
    score: Floats
    claimed_ns: Rows
    supported_ns: Rows
    refuted_ns: Rows

    @classmethod
    def empty(cls) -> ClaimTracks:
        """Return an instance without tracks."""
        none, never = np.zeros((0, 2)), np.zeros(0, np.int64)
        return cls(none, none, np.zeros((0, NUM_CHECKS), np.int8), np.zeros(0), never, never, never)

    def __len__(self) -> int:
        return len(self.xy)


def move_tracks(tracks: ClaimTracks, rotation: Floats, shift: Floats, seconds: float) -> ClaimTracks:
    """Return the tracks in the ego's frame after its motion, rotation (2, 2) and shift (2,), and after their own."""
    xy = (tracks.xy + tracks.velocity * seconds) @ rotation.T + shift
    fields = (tracks.checks, tracks.score, tracks.claimed_ns, tracks.supported_ns, tracks.refuted_ns)
    return ClaimTracks(xy, tracks.velocity @ rotation.T, *fields)


def find_tracks(tracks: ClaimTracks, xy: Floats, sigma_m: Floats) -> Rows:
    """Return (N,) the track of each claim, -1 of a new one. xy: (N, 2), sigma_m: (N,) metres."""
    return associate(xy, tracks.xy, GATE_M + sigma_m)


@dataclass(frozen=True)
class ClaimChecks:
    """What one frame shows of N claims: xy (N, 2), velocity (N, 2), score (N,), evidence (N,) uint8, and track (N,), -1 is new."""

    xy: Floats
    velocity: Floats
    score: Floats
    evidence: NDArray[np.uint8]
    track: Rows


def update_tracks(tracks: ClaimTracks, checks: ClaimChecks, now_ns: int) -> ClaimTracks:
    """Return the tracks of the N claims, in their order, then those that are not claimed now and have not ended."""
    numbers = now_ns, MAX_UNCLAIMED_NS, MAX_TRACKS, _SUPPORTED, _REFUTED
    times_ns = tracks.claimed_ns, tracks.supported_ns, tracks.refuted_ns
    history, *found_ns, left = add_checks(tracks.checks, times_ns, checks.track, checks.evidence, numbers)
    return ClaimTracks(
        np.concatenate((checks.xy, tracks.xy[left])),
        np.concatenate((checks.velocity, tracks.velocity[left])),
        history,
        np.concatenate((checks.score, tracks.score[left])),
        *found_ns,
    )


def count_refuted_checks(tracks: ClaimTracks, min_score: float) -> Rows:
    """Return (K,) the number of refuted checks of each track; 0 of a score below, or where a check is supported or disputed."""
    return count_refuted(tracks.checks, tracks.score, min_score, _REFUTED, (_SUPPORTED, _DISPUTED))
