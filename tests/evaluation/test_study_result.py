# SPDX-License-Identifier: Apache-2.0
"""Cells: classes of speed by hand, and a file that gives back what was written or nothing."""

import dataclasses
import math

import pytest
import torch

from manyeyes.evaluation.detection.average_precision import PROTOCOLS, FrameMatch, compute_ap
from manyeyes.evaluation.detection.communication import summarize_messages
from manyeyes.evaluation.study_result import BusVolume, StudyResult, filter_by_speed, read_result, write_result

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


def make_result() -> StudyResult:
    half = (frame("a", 6), frame("a", 7, ()), frame("b", 6, (-1, 1)))
    seven = (frame("a", 6, (2, -1, -1, -1)), frame("a", 7, ()), frame("b", 6, (-1, -1)))
    return StudyResult(
        "late", (half, seven), (SPEED, SPEED + 1, SPEED * 2), summarize_messages([], 3), BusVolume(0, 0.0, 0), math.nan
    )


def test_a_result_round_trips_through_its_file(tmp_path) -> None:
    write_result(tmp_path / "x.npz", make_result())
    got, wanted = read_result(tmp_path / "x.npz"), make_result()
    assert got is not None and [p.name for p in tmp_path.iterdir()] == ["x.npz"]
    for one, other in zip(got.matches, wanted.matches, strict=True):
        for a, b in zip(one, other, strict=True):
            assert (a.scenario, a.index, a.n_gt) == (b.scenario, b.index, b.n_gt)
            assert torch.equal(a.score, b.score) and torch.equal(a.truth_row, b.truth_row)
    assert all(torch.equal(a, b) for a, b in zip(got.speeds, wanted.speeds, strict=True))
    assert repr(got.communication) == repr(wanted.communication) and got.volume == wanted.volume
    assert got.method == "late" and math.isnan(got.age_ms) and got.bytes_per_message == 0


def test_scenarios_and_speeds_choose_frames() -> None:
    assert [(m.scenario, m.index) for m in make_result().select_matches(0)] == [("a", 6), ("a", 7), ("b", 6)]
    assert [(m.scenario, m.n_gt) for m in make_result().select_matches(1, {"b"}, FAST)] == [("b", 2)]


@pytest.mark.parametrize("cut", [0, 10, 200, -1])
def test_a_damaged_file_is_no_result(tmp_path, cut) -> None:
    path = tmp_path / "x.npz"
    assert read_result(path) is None
    write_result(path, make_result())
    whole = path.read_bytes()
    path.write_bytes(whole[:cut])
    assert read_result(path) is None


def test_a_result_of_another_layout_is_none(tmp_path) -> None:
    one_threshold = dataclasses.replace(make_result(), matches=make_result().matches[:1])
    write_result(tmp_path / "x.npz", one_threshold)
    assert read_result(tmp_path / "x.npz") is None
