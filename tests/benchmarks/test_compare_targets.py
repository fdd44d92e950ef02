# SPDX-License-Identifier: Apache-2.0
"""Comparisons of results with targets: by the whole interval, by patterns, and by every entry of targets.toml."""

import json
import math
import sys

import pytest
from benchmarks.compare_targets import Target, compare_study, compare_to_bounds, load_targets

from benchmarks import compare_targets
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.studies.catalog import STUDIES


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.12, 0.2, "met"),
        (0.05, 0.11, "not met"),
        (0.05, 0.12, "inconclusive"),
        (math.nan, math.nan, "inconclusive"),
        (0.31, 0.4, "not met"),
        (0.2, 0.31, "inconclusive"),
    ],
)
def test_the_whole_interval_decides(low: float, high: float, verdict: str) -> None:
    assert compare_to_bounds(Interval((low + high) / 2, low, high, 0.95, 9), 0.12, 0.3) == verdict


def test_one_scenario_is_inconclusive() -> None:
    assert compare_to_bounds(Interval(0.5, 0.5, 0.5, 0.95, 1), 0.1) == "inconclusive"


def comparison(description: str, metric: str, value: float, baseline: float | None = None) -> dict:
    interval = {"value": value, "low": value - 0.01, "high": value + 0.01, "confidence_level": 0.95, "num_scenarios": 9}
    return {"description": description, "metric": metric, "interval": interval, "baseline_value": baseline}


def test_patterns_choose_comparisons_of_one_study() -> None:
    result = {"comparisons": [comparison("a - b, 1 m", "AP@0.5", 0.2), comparison("a - b, 1 m", "AP@0.7", -0.2)]}
    targets = [Target("here", "a - *", "AP@0.5", min=0.0), Target("there", "a - *", "AP@0.5", min=0.0)]
    assert compare_study("here", result, targets) == [
        "met           a - b, 1 m, AP@0.5: 0.2 [0.19, 0.21]; target min 0"
    ]


def test_a_minimum_may_depend_on_the_baseline() -> None:
    target = Target("fusion", "*", "*", min_from_baseline="double-or-half-error")
    for ours, baseline, verdict in (
        (0.65, 0.3, "met"),
        (0.55, 0.3, "not met"),
        (0.92, 0.8, "met"),
        (0.88, 0.8, "not met"),
    ):
        (line,) = compare_study("fusion", {"comparisons": [comparison("ours", "AP", ours, baseline)]}, [target])
        assert line.startswith(verdict)


def test_rows_of_evaluate_have_targets_of_their_own(tmp_path, monkeypatch, capsys) -> None:
    interval = {"value": 0.6, "low": 0.55, "high": 0.65, "confidence_level": 0.95, "num_scenarios": 9}
    rows = [
        {"method": "no-fusion", "ap50": interval, "bytes_per_message": 0.0},
        {"method": "intermediate", "ap50": interval, "bytes_per_message": 200_000.0},
    ]
    path = tmp_path / "results.json"
    path.write_text(
        json.dumps({"result": {"rows": rows, "differences": [comparison("intermediate - no-fusion", "AP@0.5", 0.2)]}})
    )
    monkeypatch.setattr(sys, "argv", ["compare_targets.py", str(path)])
    assert compare_targets.main() == 1, "the message is too large"
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[1:4]] == ["met", "not met", "met"]


def test_every_target_is_of_a_study_that_there_is() -> None:
    targets = load_targets()
    assert {target.study for target in targets} <= {*STUDIES, "results"}
    assert all(target.field or (target.comparison and target.metric) for target in targets)
    assert all(math.isfinite(t.min) or math.isfinite(t.max) or t.min_from_baseline for t in targets)
