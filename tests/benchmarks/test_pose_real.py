# SPDX-License-Identifier: Apache-2.0
"""Lines of the benchmark of real boxes: rates, bounds and verdicts."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.pose_real import answers, judge, make_mean_line, make_rate_line, nulls

from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PoseStatus, no_estimate


def test_a_rate_has_the_rule_of_three_as_upper_bound() -> None:
    line = make_rate_line("nulls", [False] * 3000, (None, 0.002))
    assert line.value == 0.0 and line.low == 0.0 and line.high == pytest.approx(3.0 / 3000, rel=0.01) and line.met
    assert "at most 0.002: met" in str(line)
    assert not make_rate_line("nulls", [True] * 7 + [False] * 2993, (None, 0.002)).met
    assert make_rate_line("all", [True] * 10, (None, None)).high == 1.0


def test_a_mean_is_held_to_both_limits() -> None:
    assert make_mean_line("NEES", [2.0, 3.0, 4.0], (2.2, 3.4)).met
    assert not make_mean_line("NEES", [1.0, 2.0, 3.0], (2.2, 3.4)).met


def test_no_answer_is_never_right() -> None:
    outcome = judge(no_estimate(None, PoseStatus.AMBIGUOUS), np.zeros(3))
    assert not outcome.is_within(1e9) and np.isnan(outcome.nees)


def test_nulls_are_limited_to_the_requested_densities_and_both_kinds() -> None:
    correct = load_corrector("voting")
    names = [line.what for line in nulls(2, correct, ["15 x 17"])]
    assert names == [
        "nulls, 15 x 17, two places: answered",
        "nulls, 15 x 17, one place: answered",
        "nulls, 15 x 17, one place: wrong by more than 3 m",
    ]
    assert list(answers(2, correct, ["40 x 50"])) == []
