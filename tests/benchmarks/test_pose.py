# SPDX-License-Identifier: Apache-2.0
"""The targets that the pose benchmark prints behind its tables."""

from dataclasses import replace

from benchmarks.pose import Row, check_targets

from manyeyes.evaluation.pose.metrics import PoseEvaluation, summarize_evaluations
from manyeyes.pose.types import PoseStatus


def row(table: str, prior_noise: str, sigma: float, flagged: int, nees: tuple[float, ...] = (3.0,) * 100) -> Row:
    """A row of a hundred estimates, of which so many contradict the prior."""
    statuses = [PoseStatus.CONFLICT] * flagged + [PoseStatus.OK] * (100 - flagged)
    frames = [PoseEvaluation(s, 5, 0.1, 0.1, 0.1, n, 1.0) for s, n in zip(statuses, nees)]
    return Row(table, "voting", 5, 8, 10, 1, False, False, prior_noise, sigma, summarize_evaluations(frames), 1.0, 1.0)


def test_the_monitor_is_held_to_its_worst_row():
    rows = [row("monitored", "offset", 0.5, 100), row("monitored", "offset", 0.5, 97), row("monitored", "bias", 0.5, 0)]
    rows += [
        row("monitored", "offset", 1.0, 98),
        row("monitored", "gaussian", 1.0, 1),
        row("monitored", "bias", 1.0, 0),
    ]
    rows += [row("monitor", "offset", 1.0, 90), row("monitor", "gaussian", 1.0, 0)]
    assert [(target.value, target.verdict) for target in check_targets(rows)] == [
        (0.97, "not met"), (0.0, "met"), (0.98, "met"), (0.01, "not met"), (0.9, "not met"), (0.0, "met"),
    ]  # fmt: skip
    assert "over drives" in next(check_targets(rows)).what


def test_a_mean_nees_whose_interval_contains_the_target_is_inconclusive():
    wide = tuple(2.5 + (-1) ** n for n in range(100))
    apart = {"high": tuple(4.0 + 0.01 * (n % 2) for n in range(100)), "low": tuple(n % 3 for n in range(100))}
    rows = {
        "wide": row("success", "none", 0.0, 0, wide),
        "sure": row("success", "none", 0.0, 0, tuple(3.0 + 0.01 * (n % 2) for n in range(100))),
        **{name: row("acceptance", "none", 0.0, 0, nees) for name, nees in apart.items()},
    }
    verdicts = {name: [bar.verdict for bar in check_targets([one])] for name, one in rows.items()}
    assert verdicts == {"wide": ["inconclusive"], "sure": ["met"], "high": ["not met"], "low": ["not met"]}
    # There is no bar with a prior, nor without a standard error of the NEES.
    assert not list(
        check_targets([row("success", "gaussian", 1.0, 0), replace(rows["sure"], score=summarize_evaluations([]))])
    )
