# SPDX-License-Identifier: Apache-2.0
"""Lines of the benchmark of real boxes: rates, bounds and verdicts."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.pose_real import judge, make_mean_line, make_rate_line

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
