# SPDX-License-Identifier: Apache-2.0
"""Fit monotone maps of scores to the fraction of correct boxes, on a recording that the weights were not trained on.

Source: Zadrozny and Elkan, "Transforming classifier scores into accurate multiclass probability estimates", 2002 (isotonic
regression by pool-adjacent-violators), on bins of equally many boxes with a prior, so that few boxes give a smooth map.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.replay import WARMUP_FRAMES, ReplayConfig
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.average_precision import match_frame
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, run_benchmarks
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.score_calibration import MIN_CALIBRATED_SCORE, ScoreCalibration, ScoreForm, ScoreMap

METHODS = ("no-fusion", "late", "intermediate-temporal", "early")
"""One strategy of each form."""
MATCH_IOU = 0.5
"""A box is correct where it matches a vehicle at this IoU."""
MAX_BINS, MIN_BIN_BOXES = 20, 40
PRIOR_BOXES = 5.0
"""Weight of the raw score in each bin, as a number of boxes."""
RAW_FRACTION = 0.02
"""Fraction of the identity in a map, which keeps it strictly increasing."""
MIN_GAP = 0.002
"""Minimum distance of the raw scores of two knots."""


@dataclass(frozen=True)
class ScoredBoxes:
    """Evaluated boxes of one form: raw score (N,), whether correct (N,) bool, and the number of vehicles to be found."""

    score: NDArray[np.float64]
    is_correct: NDArray[np.bool_]
    num_truth: int


def calibrate_detector(
    open_recording: Callable[[], Recording],
    detector: BoxDetector,
    frame_stride: int = 1,
    workers: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[ScoreCalibration, dict[ScoreForm, ScoredBoxes]]:
    """Fit the maps of all forms to the boxes of METHODS on a recording, and return those boxes too.

    The detector is replayed as it is, so it must have no calibration; frame_stride: use every n-th evaluated frame.

    Raises:
        ConfigError: the detector is calibrated already, or no vehicle is evaluated.
    """
    if getattr(detector, "score_calibration", None) is not None:
        raise ConfigError(
            "These weights are calibrated already; fit their maps to raw scores, without the calibration."
        )
    config = BenchmarkConfig(
        detector, METHODS, replay=ReplayConfig(warmup_frames=WARMUP_FRAMES), frame_stride=frame_stride
    )
    with closing(run_benchmarks(open_recording, [config], workers, progress)) as tallies:
        boxes: dict[ScoreForm, ScoredBoxes] = {
            get_strategy(tally.method).score_form: collect_boxes(tally) for tally in next(tallies)
        }
    if not any(found.num_truth for found in boxes.values()):
        raise ConfigError(
            "No vehicle is evaluated in the recording, so scores cannot be calibrated; give one with labels."
        )
    return ScoreCalibration(**{form: fit_score_map(found) for form, found in boxes.items()}), boxes


def collect_boxes(tally: MetricAccumulator) -> ScoredBoxes:
    """Return the evaluated boxes of a method; a box is correct where it is a true positive at MATCH_IOU."""
    matches = [match_frame(frame, MATCH_IOU, tally.protocol) for frame in tally.frames]
    score = np.concatenate([match.score.numpy() for match in matches] or [np.zeros(0)])
    is_correct = np.concatenate([match.tp.numpy() for match in matches] or [np.zeros(0, dtype=bool)])
    return ScoredBoxes(score, is_correct, sum(match.n_gt for match in matches))


def fit_score_map(boxes: ScoredBoxes) -> ScoreMap:
    """Fit the map of one form; its min_drawn has the largest F1 on the same boxes."""
    raw, calibrated = _fit_knots(boxes)
    fitted = ScoreMap(raw, calibrated, 0.0)
    return ScoreMap(raw, calibrated, _find_best_threshold(boxes, fitted))


def _fit_knots(boxes: ScoredBoxes) -> tuple[tuple[float, ...], tuple[float, ...]]:
    order = np.argsort(boxes.score, kind="stable")
    score, is_correct = boxes.score[order], boxes.is_correct[order].astype(np.float64)
    above = score > MIN_CALIBRATED_SCORE
    score, is_correct = score[above], is_correct[above]
    count = int(np.clip(len(score) // MIN_BIN_BOXES, 1, MAX_BINS))
    bins = [part for part in np.array_split(np.arange(len(score)), count) if len(part)]
    center = np.array([score[part].mean() for part in bins])
    size = np.array([float(len(part)) for part in bins])
    fraction = np.array([is_correct[part].mean() for part in bins])
    smooth = (fraction * size + center * PRIOR_BOXES) / (size + PRIOR_BOXES)
    level = fit_isotonic(smooth, size + PRIOR_BOXES)
    raw = [0.0, MIN_CALIBRATED_SCORE]
    calibrated = [0.0, MIN_CALIBRATED_SCORE]
    for x, y in zip(center, level):
        if raw[-1] + MIN_GAP < x < 1 - MIN_GAP:
            raw.append(round(float(x), 6))
            mixed = (1 - RAW_FRACTION) * max(float(y), MIN_CALIBRATED_SCORE) + RAW_FRACTION * float(x)
            calibrated.append(round(mixed, 6))
    return (*raw, 1.0), (*calibrated, 1.0)


def fit_isotonic(value: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the non-decreasing values (N,) of least weighted squares to value (N,): pool adjacent violators."""
    blocks: list[tuple[float, float, int]] = []
    for v, w in zip(value.tolist(), weight.tolist()):
        blocks.append((v, w, 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, weight_a, count_a), (b, weight_b, count_b) = blocks[-2:]
            total = weight_a + weight_b
            blocks[-2:] = [((a * weight_a + b * weight_b) / total, total, count_a + count_b)]
    return np.repeat([b[0] for b in blocks], [b[2] for b in blocks]).astype(np.float64)


def _find_best_threshold(boxes: ScoredBoxes, fitted: ScoreMap) -> float:
    """Return the calibrated score that separates drawn boxes best: the largest 2 TP / (boxes + vehicles)."""
    if not len(boxes.score):
        return MIN_CALIBRATED_SCORE
    score = fitted.apply(torch.from_numpy(boxes.score)).numpy()
    order = np.argsort(-score, kind="stable")
    f1 = 2 * np.cumsum(boxes.is_correct[order]) / (np.arange(1, len(order) + 1) + max(1, boxes.num_truth))
    best = int(np.argmax(f1))
    following = score[order[best + 1]] if best + 1 < len(order) else MIN_CALIBRATED_SCORE
    return round(float((score[order[best]] + following) / 2), 4)
