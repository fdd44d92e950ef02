# SPDX-License-Identifier: Apache-2.0
"""Tables of stored benchmarks of pose correction."""

from __future__ import annotations

from typing import Any

from manyeyes.viz.stored_pose_tables import is_pose_lines, is_pose_rows, make_pose_lines, make_pose_rows


def make_line(what: str, value: float, met: bool | None = None, target: str = "") -> dict[str, Any]:
    return {
        "what": what,
        "value": value,
        "low": value - 0.1,
        "high": value + 0.1,
        "count": 600,
        "target": target,
        "met": met,
    }


def test_a_row_is_a_case_and_a_column_a_measure() -> None:
    lines = [
        make_line("answers, 15 x 17, 4 common: answered", 0.5),
        make_line("answers, 15 x 17, 4 common: mean NEES", 2.5, False, "at most 2"),
        make_line("answers, 25 x 31, 8 common: answered", 0.75),
        make_line("nulls, 15 x 17: answered", float("nan")),
    ]
    assert is_pose_lines({"lines": lines}) and not is_pose_lines({"lines": ["text"], "study": "x"} | {"lines": []})
    answers, nulls = make_pose_lines({"lines": lines})
    assert answers.name == "answers" and answers.lines == [
        ("case", "answered", "mean NEES", "of"),
        ("answers, 15 x 17, 4 common", "0.500 [0.400, 0.600]", "2.500 [2.400, 2.600] (not met: at most 2)", "600"),
        ("answers, 25 x 31, 8 common", "0.750 [0.650, 0.850]", "-", "600"),
    ]
    assert nulls.lines[1] == ("nulls, 15 x 17", "not run", "600")


def test_small_rates_have_four_digits_and_exact_ones_no_bounds() -> None:
    rate = make_line("a, b: wrong", 0.0010) | {"low": 0.0005, "high": 0.0021}
    exact = make_line("a, c: wrong", 0.88) | {"low": 0.88, "high": 0.88, "count": 0}
    (table,) = make_pose_lines({"lines": [rate, exact]})
    assert table.lines[1:] == [("a, b", "0.0010 [0.0005, 0.0021]", "600"), ("a, c", "0.880", "-")]


def test_rows_of_correctors_are_percent_and_milliseconds() -> None:
    row = {"corrector": "voting", "answered": 0.9667, "median_ms": 6.46, "ratio": 1.234, "met": True}
    result = {"benchmark": "pose_global", "rows": [row]}
    assert is_pose_rows(result) and not is_pose_rows({"rows": [row]})
    (table,) = make_pose_rows(result)
    assert table.lines == [
        ("corrector", "answered [%]", "median ms", "ratio", "met"),
        ("voting", "96.7", "6.5", "1.23", "yes"),
    ]
