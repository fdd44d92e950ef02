# SPDX-License-Identifier: Apache-2.0
"""True objects that an attack removes: found without it at a score, and not found with it."""

from __future__ import annotations

from collections.abc import Iterable

from manyeyes.evaluation.detection.frame_match import FrameMatch


def count_removed(
    clean: Iterable[FrameMatch], attacked: Iterable[FrameMatch], min_score: float = 0.5
) -> tuple[int, int]:
    """Return the number of true objects that are found in clean frames, and of those that are not found in the attacked ones.

    Frames are in the same order; both runs have the same truth.
    """
    found = removed = 0
    for before, after in zip(clean, attacked, strict=True):
        rows = _found_rows(before, min_score)
        found += len(rows)
        removed += len(rows - _found_rows(after, min_score))
    return found, removed


def _found_rows(match: FrameMatch, min_score: float) -> set[int]:
    return set(match.truth_row[(match.truth_row >= 0) & (match.score >= min_score)].tolist())
