# SPDX-License-Identifier: Apache-2.0
"""Frames of one class before and after matching, and the list that their detections form.

The order of the list, and what equal scores mean in it, are rules of :mod:`manyeyes.evaluation.detection.average_precision`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes import VEHICLES, Boxes, ConfigError
from manyeyes.evaluation.detection.protocols import DetectionProtocol

Order = Literal["global", "concatenated"]


@dataclass(frozen=True)
class FrameResult:
    """What one ego found in one frame, and what was there; both in the ego's true frame."""

    scenario: str
    index: int
    detections: Boxes
    truth: Boxes


@dataclass(frozen=True)
class FrameIou:
    """A frame of one class, ready to be matched at any threshold: score (D,) descending, iou (D, G), both float64."""

    scenario: str
    index: int
    score: Tensor
    iou: Tensor
    class_name: str = VEHICLES[0]


@dataclass(frozen=True)
class FrameMatch:
    """A matched frame of one class.

    score: (D,) float64, descending. truth_row: (D,) int64, the truth box taken, -1 a false positive. overlap_row: (D,) int64,
    the truth box that a detection overlaps most, -1 where it overlaps none by ``MIN_OVERLAP_IOU``; None where it is not known.
    """

    scenario: str
    index: int
    score: Tensor
    truth_row: Tensor
    n_gt: int
    class_name: str = VEHICLES[0]
    overlap_row: Tensor | None = None

    @property
    def tp(self) -> Tensor:
        """(D,) bool: which detections are true positives; the others are false positives."""
        return self.truth_row >= 0


@dataclass(frozen=True)
class RankedMatches:
    """Detections of many frames as one list.

    tp: (D,) bool. frame: (D,) int64, index into the frames. group_start: (K,) int64, where each group of detections begins that
    form one step of the curve: those of equal score, or each by itself.
    """

    tp: NDArray[np.bool_]
    frame: NDArray[np.int64]
    group_start: NDArray[np.int64]


def sum_groups(values: NDArray[np.float64], group_start: NDArray[np.int64] | None) -> NDArray[np.float64]:
    """Return the sums (..., K) of values (..., D) over each group; group_start: (K,) where each begins, None: one value each."""
    if group_start is None or len(group_start) == values.shape[-1]:
        return values
    return np.add.reduceat(values, group_start, axis=-1)


def sort_by_frame(matches: Sequence[FrameMatch]) -> list[FrameMatch]:
    """Return frames by (scenario, index); stable.

    Raises:
        ConfigError: they are of several classes.
    """
    classes = sorted({match.class_name for match in matches})
    if len(classes) > 1:
        raise ConfigError(
            f"A detection metric is of one class; the frames are of {', '.join(classes)}: select those of one."
        )
    return sorted(matches, key=lambda match: (match.scenario, match.index))


def count_truth(match: FrameMatch, protocol: DetectionProtocol) -> int:
    """Return how many truth boxes of a frame the protocol counts."""
    return match.n_gt if len(match.score) or protocol.count_frames_without_det else 0


def rank_matches(matches: Sequence[FrameMatch], protocol: DetectionProtocol, order: Order) -> RankedMatches:
    """Return the detections of frames, which are in their order already, as the list of an order of the protocol."""
    frame = np.repeat(np.arange(len(matches)), [len(match.score) for match in matches])
    if not len(frame):
        return RankedMatches(np.zeros(0, dtype=bool), frame, np.zeros(0, dtype=np.int64))
    score = np.concatenate([match.score.numpy() for match in matches])
    truth_row = np.concatenate([match.truth_row.numpy() for match in matches])
    if order == "concatenated":
        rank = np.arange(len(score))
    elif protocol.ties == "numpy":
        rank = np.argsort(-score)
    elif protocol.ties == "hits_first":
        # Within a frame and a score: hits by their truth box, then the others in their order.
        rank = np.lexsort((np.where(truth_row >= 0, truth_row, len(score)), frame, -score))
    else:
        rank = np.argsort(-score, kind="stable")
    starts = np.arange(len(score))
    if protocol.ties == "together":
        sorted_score, sorted_frame = score[rank], frame[rank]
        is_new = np.diff(sorted_score, prepend=np.inf) != 0
        if order == "concatenated":
            is_new |= np.diff(sorted_frame, prepend=-1) != 0
        starts = np.flatnonzero(is_new)
    return RankedMatches((truth_row >= 0)[rank], frame[rank], starts)
