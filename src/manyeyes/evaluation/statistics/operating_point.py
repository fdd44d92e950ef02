# SPDX-License-Identifier: Apache-2.0
"""Metrics of a detector at one score threshold, as a user runs it, with intervals over scenarios.

Of the detections with score >= the threshold: precision, recall and F (their harmonic mean) at the IoU threshold of the
matches; false alarms a frame, which are the false positives; and duplicates per object. A detection is of the truth box that it
overlaps most, where the IoU is at least ``MIN_OVERLAP_IOU``, correct or not; duplicates are those beyond the first of each box,
over the number of truth boxes. Sums over frames are taken first, ratios last. A protocol that matches by truth
(``truth_first``) is matched with all its detections, before the threshold.

The threshold is chosen on other data than it is used on: a card of weights holds one for each form of result (``manyeyes
calibrate``), or an evaluation of a validation split stores the one of greatest F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes.evaluation.detection.frame_match import FrameMatch, count_truth, sort_by_frame
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval, draw_resamples, make_interval

NUM_RESAMPLES = 1000


@dataclass(frozen=True)
class OperatingThreshold:
    """The minimum score of a detection that is used, and where it comes from: the card of the weights, an evaluation of a
    validation split, or the default of uncalibrated weights, which was chosen for no method.
    """

    score: float
    source: Literal["weights", "validation", "default"]


@dataclass(frozen=True)
class OperatingPoint:
    """Metrics at a threshold; NaN where there is nothing to divide by."""

    threshold: OperatingThreshold
    precision: Interval
    recall: Interval
    f_score: Interval
    false_alarms_per_frame: Interval
    duplicates_per_object: Interval


def compute_operating_point(
    matches: Sequence[FrameMatch],
    threshold: OperatingThreshold,
    protocol: DetectionProtocol,
    confidence_level: float = 0.95,
) -> OperatingPoint:
    """Return the metrics of matched frames of one class at a threshold; resamples are those of :func:`bootstrap`."""
    names, counts = _count_by_scenario(matches, threshold.score, protocol)
    weights = np.vstack((np.ones((1, len(names)), dtype=np.int64), draw_resamples(len(names), NUM_RESAMPLES, 0)))
    hits, found, n_gt, duplicates, frames = (weights @ counts).T.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        columns = (
            hits / found,
            hits / n_gt,
            2 * hits / (found + n_gt),
            (found - hits) / frames,
            duplicates / n_gt,
        )
    intervals = (make_interval(float(c[0]), c[1:], confidence_level, len(names)) for c in columns)
    return OperatingPoint(threshold, *intervals)


def find_best_threshold(matches: Sequence[FrameMatch], protocol: DetectionProtocol) -> float | None:
    """Return the score with the greatest F of matched frames of one class, of equal ones the greatest; None without detections."""
    matches = sort_by_frame(matches)
    score = np.concatenate([match.score.numpy() for match in matches] or [np.zeros(0)])
    if not len(score):
        return None
    tp = np.concatenate([match.tp.numpy() for match in matches])
    order = np.argsort(-score, kind="stable")
    is_last = np.diff(score[order], append=-np.inf) != 0
    n_gt = sum(count_truth(match, protocol) for match in matches)
    f_score = 2 * np.cumsum(tp[order]) / (np.arange(1, len(order) + 1) + n_gt)
    return float(score[order][int(np.argmax(np.where(is_last, f_score, -1.0)))])


def _count_by_scenario(
    matches: Sequence[FrameMatch], min_score: float, protocol: DetectionProtocol
) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Return names of scenarios, and (S, 5): hits, detections, truth boxes, duplicates, frames of each."""
    matches = sort_by_frame(matches)
    names = tuple(dict.fromkeys(match.scenario for match in matches))
    counts = np.zeros((len(names), 5), dtype=np.int64)
    for match in matches:
        used = match.score.numpy() >= min_score
        overlaps = np.full(len(used), -1) if match.overlap_row is None else match.overlap_row.numpy()
        owners = overlaps[used & (overlaps >= 0)]
        counts[names.index(match.scenario)] += (
            int((match.tp.numpy() & used).sum()),
            int(used.sum()),
            count_truth(match, protocol),
            len(owners) - len(np.unique(owners)),
            1,
        )
    return names, counts
