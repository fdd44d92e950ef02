# SPDX-License-Identifier: Apache-2.0
"""Cells: classes of speed by hand, and what is selected of a result."""

import math

import pytest
import torch

from manyeyes.evaluation.detection.average_precision import PROTOCOLS, FrameMatch, compute_ap
from manyeyes.evaluation.detection.communication import summarize_messages
from manyeyes.studies.engine.conditions import BusVolume, MethodMatches, filter_by_speed

STILL, SLOW, FAST = (0.0, 0.1), (0.1, 5.0), (5.0, math.inf)


def frame(scenario: str = "a", index: int = 6, rows: tuple[int, ...] = (2, -1, 0, 1)) -> FrameMatch:
    """Four detections on three true boxes: the best took box 2, the next nothing, then boxes 0 and 1."""
    score = torch.tensor([0.9, 0.8, 0.7, 0.6], dtype=torch.float64)[: len(rows)]
    return FrameMatch(scenario, index, score, torch.tensor(rows, dtype=torch.int64), 3)


SPEED = torch.tensor([0.0, 4.9, 5.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("speeds", "rows", "scores"),
    [(STILL, [-1, 0], [0.8, 0.7]), (SLOW, [-1, 1], [0.8, 0.6]), (FAST, [2, -1], [0.9, 0.8])],
)
def test_detections_matched_to_another_class_are_ignored_and_unmatched_are_false(speeds, rows, scores) -> None:
    got = filter_by_speed(frame(), SPEED, speeds)
    assert got.truth_row.tolist() == rows and got.score.tolist() == scores and got.n_gt == 1


def test_ap_of_a_class_by_hand() -> None:
    # Fast: found first, precision 1 at recall 1. Still: behind one false positive, precision 1/2 at recall 1.
    ap = {
        speeds: compute_ap([filter_by_speed(frame(), SPEED, speeds)], PROTOCOLS["global-sort"]).ap
        for speeds in (FAST, STILL)
    }
    assert ap == {FAST: 1.0, STILL: 0.5}


def test_a_frame_without_boxes_of_a_class_counts_its_false_alarms() -> None:
    got = filter_by_speed(frame(rows=(0, -1)), torch.zeros(3), FAST)
    assert got.truth_row.tolist() == [-1] and got.n_gt == 0
    empty = filter_by_speed(
        FrameMatch("a", 0, torch.zeros(0), torch.zeros(0, dtype=torch.int64), 0), torch.zeros(0), FAST
    )
    assert len(empty.score) == empty.n_gt == 0


def make_result() -> MethodMatches:
    half = (frame("a", 6), frame("a", 7, ()), frame("b", 6, (-1, 1)))
    seven = (frame("a", 6, (2, -1, -1, -1)), frame("a", 7, ()), frame("b", 6, (-1, -1)))
    return MethodMatches(
        "late",
        (half, seven),
        (SPEED, SPEED + 1, SPEED * 2),
        summarize_messages([], 3),
        BusVolume(0, 0.0, 0),
        math.nan,
        3,
    )


def test_scenarios_and_speeds_choose_frames() -> None:
    assert [(m.scenario, m.index) for m in make_result().select_matches(0, "vehicle")] == [("a", 6), ("a", 7), ("b", 6)]
    assert [(m.scenario, m.n_gt) for m in make_result().select_matches(1, "vehicle", {"b"}, FAST)] == [("b", 2)]
