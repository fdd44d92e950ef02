# SPDX-License-Identifier: Apache-2.0
"""Compare results of studies with the targets of the project: ``python benchmarks/compare_targets.py STUDY.json ...``.

Targets are in targets.toml. A target is met where the whole 95 % interval is within its bounds, not met where all of it is outside
one of them, else inconclusive; so is every comparison over a single scenario.
"""

from __future__ import annotations

import json
import math
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from manyeyes.evaluation.statistics.bootstrap import Interval

TARGETS = Path(__file__).with_name("targets.toml")


@dataclass(frozen=True)
class Target:
    """One entry of targets.toml: what is compared in which study, and its bounds."""

    study: str
    comparison: str = ""
    metric: str = ""
    method: str = ""
    field: str = ""
    min: float = -math.inf
    max: float = math.inf
    min_from_baseline: str = ""


def compare_to_bounds(interval: Interval, minimum: float, maximum: float = math.inf) -> str:
    """Compare an interval with bounds: met, not met or inconclusive."""
    if interval.low >= minimum and interval.high <= maximum and interval.num_scenarios > 1:
        return "met"
    is_outside = (interval.high < minimum or interval.low > maximum) and interval.num_scenarios > 1
    return "not met" if is_outside else "inconclusive"


def find_values(target: Target, result: dict[str, Any]) -> Iterator[tuple[str, Interval, float | None]]:
    """Iterate over the values that a target is about: name, interval, value of the baseline."""
    for row in result.get("rows", ()) if target.field else ():
        value = row.get(target.field) if row["method"] == target.method else None
        if isinstance(value, dict):
            yield f"{target.method}, {target.field}", _read_interval(value), None
        elif value is not None:
            # A count has no interval: it is compared as it is.
            yield f"{target.method}, {target.field}", Interval(value, value, value, 0.95, 2), None
    for one in (*result.get("comparisons", ()), *result.get("differences", ())):
        if fnmatchcase(one["description"], target.comparison) and fnmatchcase(one["metric"], target.metric):
            yield f"{one['description']}, {one['metric']}", _read_interval(one["interval"]), one["baseline_value"]


def _read_interval(stored: dict[str, Any]) -> Interval:
    """Read an interval; JSON has null for NaN, which no bound contains."""
    return Interval(**{name: math.nan if value is None else value for name, value in stored.items()})


def compare_study(study: str, result: dict[str, Any], targets: list[Target]) -> list[str]:
    """Compare one study with its targets, a line for each value."""
    lines = []
    for target in targets:
        for name, interval, baseline in find_values(target, result) if target.study == study else ():
            minimum = target.min
            if target.min_from_baseline == "double-or-half-error" and baseline is not None:
                minimum = min(2 * baseline, baseline + 0.5 * (1 - baseline))
            verdict = compare_to_bounds(interval, minimum, target.max)
            bounds = "".join(
                f" {word} {bound:g}" for word, bound in (("min", minimum), ("max", target.max)) if math.isfinite(bound)
            )
            spread = f"{interval.value:.4g} [{interval.low:.4g}, {interval.high:.4g}]"
            lines.append(f"{verdict:12}  {name}: {spread}; target{bounds}")
    return lines


def load_targets(path: Path = TARGETS) -> list[Target]:
    """Read the table of targets; a misspelt field is an error."""
    return [Target(**entry) for entry in tomllib.loads(path.read_text(encoding="utf-8"))["target"]]


def main() -> int:
    """Print met, not met or inconclusive for each target; the exit code is 1 where one is not met."""
    targets, is_missed = load_targets(), False
    for path in map(Path, sys.argv[1:]):
        lines = compare_study(path.stem, json.loads(path.read_text(encoding="utf-8"))["result"], targets)
        sys.stdout.write("\n".join([f"{path.stem}:", *lines, ""]) + "\n")
        is_missed |= any(line.startswith("not met") for line in lines)
    return int(is_missed)


if __name__ == "__main__":
    raise SystemExit(main())
