# SPDX-License-Identifier: Apache-2.0
"""Null pairs of a hand-made recording, and risk against coverage counted by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import Transform
from manyeyes.evaluation.pose.accuracy import LandmarkPair
from manyeyes.evaluation.pose.metrics import PoseEvaluation
from manyeyes.evaluation.pose.null_pairs import (
    COVERAGES,
    NullRun,
    compute_null_risk,
    find_wrong_nulls,
    make_null_pairs,
    run_null_pairs,
    summarize_null_run,
)
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseStatus


def make_landmarks(seed: int, count: int = 10) -> Landmarks:
    rng = np.random.default_rng(seed)
    rows = np.column_stack(
        (rng.uniform(-30, 30, (count, 2)), rng.uniform(-3, 3, count), np.full((count, 2), (4.5, 1.9)), np.ones(count))
    )
    return Landmarks.of(rows)


def make_pair(scenario: str, index: int, seed: int) -> LandmarkPair:
    """An ego that drives 1 m per index, and an agent that stands at (12, -3) of the scene, both at a tenfold index of seed."""
    other = Transform.from_xyz_yaw(12.0, -3.0, 0.0, 2.0)
    world_from_ego = Transform.from_xyz_yaw(float(index), 0.0, 0.0, 0.0)
    here = make_landmarks(seed)
    ego, theirs = (here.transform(to_pose(t.inverse())) for t in (world_from_ego, other))
    return LandmarkPair(scenario, index, 7, ego, theirs, world_from_ego.inverse() @ other, ego.xy, 100, world_from_ego)


def to_pose(t: Transform) -> np.ndarray:
    return np.array([*t.translation[:2].tolist(), float(t.yaw)])


def make_evaluation(confidence: float, error_m: float = 0.1) -> PoseEvaluation:
    status = PoseStatus.CORRECTED if math.isfinite(confidence) else PoseStatus.NO_MATCH
    return PoseEvaluation(status, 5, error_m, 0.1, 0.1, 1.0, confidence)


def test_null_pairs_are_of_the_next_scenario_and_of_the_farthest_instant() -> None:
    pairs = [make_pair("a", 0, 1), make_pair("a", 4, 1), make_pair("b", 2, 2)]
    found = make_null_pairs(pairs)
    assert [(n.kind, n.pair.scenario, n.pair.index) for n in found] == [
        ("other place", "a", 0), ("same place", "a", 0), ("other place", "a", 4), ("same place", "a", 4),
        ("other place", "b", 2),
    ]  # fmt: skip
    assert found[0].pair.other is pairs[2].other and found[4].pair.other is pairs[0].other
    assert found[1].pair.other is pairs[1].other
    # The other agent stands still, so that its pose in the ego's frame is that of its own instant.
    np.testing.assert_allclose(to_pose(found[1].pair.ego_from_other), to_pose(pairs[0].ego_from_other), atol=1e-9)
    moved = replace(pairs[1], ego_from_other=Transform.from_xyz_yaw(1.0, 2.0, 0.0, 0.5))
    expected = Transform.from_xyz_yaw(4.0 + 1.0, 2.0, 0.0, 0.5)
    np.testing.assert_allclose(
        to_pose(make_null_pairs([pairs[0], moved])[0].pair.ego_from_other), to_pose(expected), atol=1e-9
    )
    assert make_null_pairs(pairs[2:]) == []


def test_a_corrector_answers_at_the_same_place_and_not_at_another() -> None:
    pairs = [make_pair("a", 0, 1), make_pair("a", 4, 1), make_pair("b", 2, 2)]
    other, same = summarize_null_run("voting", run_null_pairs(pairs, "voting"))
    assert (other.kind, other.num_true, other.num_null, other.coverage) == ("other place", 3, 3, 1.0)
    assert other.answered == other.wrong == 0.0 and set(other.risk_by_coverage) == {0.0}
    # What is parked here is everything, and the pose is right.
    assert (same.num_null, same.answered, same.wrong) == (2, 1.0, 0.0)


def test_risk_is_counted_by_hand() -> None:
    true = [make_evaluation(9.0), make_evaluation(7.0), make_evaluation(5.0, 4.0), make_evaluation(-math.inf)]
    null = [make_evaluation(8.0, 50.0), make_evaluation(-math.inf, 50.0)]
    is_wrong = find_wrong_nulls("other place", null)
    assert is_wrong.tolist() == [True, False]
    risk = compute_null_risk(true, null, is_wrong)
    # Two null pairs count as four: one answer of theirs weighs 2. At 25 %: none above 9; at 50 %: 2 of 4; at 75 %: 3 of 5.
    by_coverage = dict(zip(COVERAGES, risk))
    assert by_coverage[0.05] == by_coverage[0.25] == 0.0
    assert by_coverage[0.3] == by_coverage[0.5] == pytest.approx(0.5)
    assert by_coverage[0.75] == pytest.approx(0.6)
    assert math.isnan(by_coverage[0.8]) and math.isnan(by_coverage[1.0])
    # Near the true pose an answer at the same place is right.
    assert find_wrong_nulls("same place", [make_evaluation(1.0, 2.9), make_evaluation(1.0, 3.1)]).tolist() == [
        False,
        True,
    ]


def test_answers_of_equal_confidence_come_in_as_one_in_any_order() -> None:
    true = [make_evaluation(1.0), make_evaluation(1.0, 9.0)]
    for order in (true, true[::-1]):
        risk = compute_null_risk(order, [make_evaluation(1.0, 9.0)], np.array([True]))
        assert risk.tolist() == pytest.approx([0.75] * 20)
    assert summarize_null_run("x", NullRun((), ((), ()))) == []
