# SPDX-License-Identifier: Apache-2.0
"""Tracks of the claims of one sender: the evidence on one claimed object over the last frames.

Evidence is kept for each claimed object, not for each sender: the true claims of a sender would hide a single false one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.trust.association import Floats, Rows, associate
from manyeyes.agents.trust.interface import Evidence

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

    def __getitem__(self, rows: Rows) -> ClaimTracks:
        return ClaimTracks(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def count(self, kind: Evidence) -> Rows:
        """Return (K,) the number of checks of a kind."""
        return (self.checks == kind).sum(1)


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
    is_known, before = checks.track >= 0, tracks[checks.track.clip(0)] if len(tracks) else None
    shape = (len(checks.xy), NUM_CHECKS - 1)
    history, supported, refuted = np.full(shape, NO_CHECK, np.int8), *np.zeros((2, len(checks.xy)), np.int64)
    if before is not None:
        history[is_known] = before.checks[is_known, :-1]
        supported[is_known], refuted[is_known] = before.supported_ns[is_known], before.refuted_ns[is_known]
    supported[checks.evidence == Evidence.SUPPORTED] = now_ns
    refuted[checks.evidence == Evidence.REFUTED] = now_ns
    claimed = ClaimTracks(
        checks.xy,
        checks.velocity,
        np.concatenate((checks.evidence[:, None].astype(np.int8), history), 1),
        checks.score,
        np.full(len(checks.xy), now_ns, np.int64),
        supported,
        refuted,
    )
    is_left = np.abs(now_ns - tracks.claimed_ns) <= MAX_UNCLAIMED_NS
    is_left[checks.track[is_known]] = False
    return concatenate(claimed, tracks[np.flatnonzero(is_left)[: max(0, MAX_TRACKS - len(claimed))]])


def concatenate(one: ClaimTracks, other: ClaimTracks) -> ClaimTracks:
    """Return the tracks of both."""
    names = one.__dataclass_fields__
    return ClaimTracks(*(np.concatenate((getattr(one, name), getattr(other, name))) for name in names))
