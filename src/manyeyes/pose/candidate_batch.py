# SPDX-License-Identifier: Apache-2.0
"""Candidates of the vote as the input of the learned matcher (models/pose/candidate_matcher.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.models.pose.candidate_matcher import NUM_COLUMNS, CandidateBatch
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.voting import Candidate

MAX_CANDIDATES = 5
"""The vote's best candidates, of which the network chooses; in generated scenes the right one is nearly never below."""
MAX_PAIRS = 12
"""Of a candidate; so many pairs are accepted in any case."""


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """One scene. a, b: (N, 9) and (M, 9) boxes; pose: (K, 3); score: (K,); pairs: (K, P, 2) rows, -1 for padding."""

    a: NDArray[np.float32]
    b: NDArray[np.float32]
    pose: NDArray[np.float32]
    score: NDArray[np.float32]
    pairs: NDArray[np.int64]

    @classmethod
    def of(
        cls, ego: Landmarks, other: Landmarks, found: Sequence[Candidate], max_count: int = MAX_CANDIDATES
    ) -> CandidateSet:
        """Return the best candidates of one instant's boxes, padded to max_count."""
        best = found[:max_count]
        pairs = np.full((max_count, MAX_PAIRS, 2), -1, np.int64)
        pose, score = np.zeros((max_count, 3), np.float32), np.zeros(max_count, np.float32)
        for k, one in enumerate(best):
            count = min(len(one.pairs), MAX_PAIRS)
            pose[k], score[k], pairs[k, :count] = one.pose, one.score, one.pairs[:count]
        return cls(_make_columns(ego), _make_columns(other), pose, score, pairs)


def _make_columns(x: Landmarks) -> NDArray[np.float32]:
    return np.column_stack((x.xy, x.yaw, x.size, x.score, x.sigma_xy, x.sigma_yaw, x.p_flip)).astype(np.float32)


def make_batch(sets: Sequence[CandidateSet]) -> CandidateBatch:
    """Pad scenes to the largest number of boxes."""
    sides, masks = [], []
    for name in ("a", "b"):
        boxes = [getattr(s, name) for s in sets]
        size = max((len(x) for x in boxes), default=0)
        padded = np.zeros((len(sets), size, NUM_COLUMNS), np.float32)
        mask = np.zeros((len(sets), size), bool)
        for n, x in enumerate(boxes):
            padded[n, : len(x)], mask[n, : len(x)] = x, True
        sides.append(torch.from_numpy(padded))
        masks.append(torch.from_numpy(mask))
    pose, score, pairs = (
        torch.from_numpy(np.stack([getattr(s, name) for s in sets])) for name in ("pose", "score", "pairs")
    )
    return CandidateBatch(sides[0], sides[1], masks[0], masks[1], pose, score, pairs)
