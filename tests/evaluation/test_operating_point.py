# SPDX-License-Identifier: Apache-2.0
"""Metrics at a score threshold, counted by hand."""

import math
from dataclasses import replace

import pytest
import torch
from tests.evaluation.test_average_precision import cars

from manyeyes.evaluation.detection.average_precision import FrameResult, match_frame
from manyeyes.evaluation.detection.frame_match import FrameMatch
from manyeyes.evaluation.detection.protocols import PROTOCOLS
from manyeyes.evaluation.statistics.operating_point import (
    OperatingThreshold,
    compute_operating_point,
    find_best_threshold,
)

PROTOCOL = PROTOCOLS["global-sort"]
NO_NMS = replace(PROTOCOL, nms_iou=1.0)


def at(score: float) -> OperatingThreshold:
    return OperatingThreshold(score, "weights")


def frame(scenario: str, rows: list[tuple[float, int, int]], n_gt: int, index: int = 0) -> FrameMatch:
    """Rows: score, truth box taken, truth box overlapped."""
    score, taken, overlapped = (torch.tensor(column) for column in zip(*rows, strict=True))
    return FrameMatch(scenario, index, score.double(), taken, n_gt, overlap_row=overlapped)


FRAMES = [
    frame("a", [(0.9, 0, 0), (0.8, -1, 0), (0.7, 1, 1), (0.3, -1, -1)], 3),
    frame("a", [(0.6, -1, -1), (0.2, 0, 0)], 1, index=1),
    frame("b", [(0.9, 0, 0)], 2),
]


def test_precision_recall_f_false_alarms_and_duplicates_by_hand() -> None:
    """From 0.5 on: five detections, three hits, six true boxes, three frames, one second box of an object."""
    got = compute_operating_point(FRAMES, at(0.5), PROTOCOL)
    assert got.precision.value == pytest.approx(3 / 5) and got.recall.value == pytest.approx(3 / 6)
    assert got.f_score.value == pytest.approx(2 * 0.6 * 0.5 / 1.1)
    assert got.false_alarms_per_frame.value == pytest.approx(2 / 3)
    assert got.duplicates_per_object.value == pytest.approx(1 / 6)
    assert got.precision.num_scenarios == 2 and got.threshold == at(0.5)


def test_a_score_equal_to_the_threshold_is_used() -> None:
    assert compute_operating_point(FRAMES, at(0.6), PROTOCOL).false_alarms_per_frame.value == pytest.approx(2 / 3)
    assert compute_operating_point(FRAMES, at(0.61), PROTOCOL).false_alarms_per_frame.value == pytest.approx(1 / 3)


def test_intervals_are_those_of_resampled_scenarios() -> None:
    """Of two scenarios a resample is a a, a b or b b: recall 2/4, 3/6 or 1/2, precision 2/4, 3/5 or 1."""
    got = compute_operating_point(FRAMES, at(0.5), PROTOCOL)
    assert (got.recall.low, got.recall.high) == (0.5, 0.5)
    assert (got.precision.low, got.precision.high) == (0.5, 1.0)


def test_the_best_threshold_has_the_greatest_f() -> None:
    """F at .9: 4/8, .8: 4/9, .7: 6/10, .6: 6/11, .3: 6/12, .2: 8/13."""
    assert find_best_threshold(FRAMES, PROTOCOL) == pytest.approx(0.2)
    assert find_best_threshold(FRAMES[:1] + FRAMES[2:], PROTOCOL) == pytest.approx(0.7)
    assert find_best_threshold([], PROTOCOL) is None


def test_equal_scores_are_used_together() -> None:
    """Of two boxes of score 0.8 one is a hit; the threshold cannot part them."""
    frames = [frame("a", [(0.8, 0, 0), (0.8, -1, -1)], 1)]
    assert find_best_threshold(frames, PROTOCOL) == pytest.approx(0.8)
    assert compute_operating_point(frames, at(0.8), PROTOCOL).precision.value == 0.5


def test_without_detections_precision_is_unknown_and_recall_is_zero() -> None:
    got = compute_operating_point(FRAMES, at(0.95), PROTOCOL)
    assert math.isnan(got.precision.value) and got.recall.value == 0.0
    assert got.false_alarms_per_frame.value == 0.0 and got.duplicates_per_object.value == 0.0


def test_a_displaced_pair_of_boxes_of_one_object_is_one_duplicate_and_two_false_alarms() -> None:
    """Boxes 1.1 m to either side of a car of 2 m width: IoU 0.29 with it each, none with each other, so that neither is
    suppressed.
    """
    found = cars((0, 1.1, 0.9), (0, -1.1, 0.8), (30, 0, 0.7))
    match = match_frame(FrameResult("a", 0, found, cars((0, 0, 1))), 0.5, PROTOCOL)
    assert match.overlap_row is not None and match.overlap_row.tolist() == [0, 0, -1]
    got = compute_operating_point([match], at(0.5), PROTOCOL)
    assert got.false_alarms_per_frame.value == 3 and got.duplicates_per_object.value == 1


def test_an_overlap_below_a_tenth_is_no_detection_of_the_object() -> None:
    """Boxes of 4 m by 2 m, 3.3 m apart lengthwise: IoU 1.4 / 14.6 is below 0.1; 3.2 m apart it is 1.6 / 14.4."""
    for x, owner in ((3.3, -1), (3.2, 0)):
        match = match_frame(FrameResult("a", 0, cars((x, 0, 0.9)), cars((0, 0, 1))), 0.5, NO_NMS)
        assert match.overlap_row is not None and match.overlap_row.tolist() == [owner]
