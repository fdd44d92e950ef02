# SPDX-License-Identifier: Apache-2.0
"""Print the bars of misbehaviour detection, and store them as a table for documents.

    python benchmarks/attack_bars.py attacks.json false-accusations.json --out benchmarks/results/attack_bars.json

Each line states a bar, the measured quantity with its interval and number of samples, and whether it is met: where the whole 95 %
interval is on the right side. "Not met" is where all of it is on the wrong side, else the result is inconclusive.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from manyeyes.studies import provenance
from manyeyes.viz.study_table import StudyTable

MAX_LOSS_TO_ORACLE, MAX_CLEAN_COST = 0.01, 0.003
MIN_NAMED_5, MIN_NAMED_10, MIN_NAMED_SEEN = 0.95, 0.99, 0.80
MAX_ACCUSATION_RATE, MIN_SENDER_MINUTES = 0.01, 300.0
MIN_NAMED_COLLUDING = 0.80
MIN_SCENARIOS = 10
"""A difference of AP over fewer scenarios is inconclusive: their bootstrap has too few resamples."""
COLLUDING, PERSISTENT_SEEN = ("collude-3",), ("ghost-1-seen", "ghost-3-seen", "ghost-10-seen")
NO_ATTACK, NO_DEFENCE, ORACLE = "none", "none", "oracle"


@dataclass(frozen=True)
class Measured:
    """A quantity that a bar bounds: at least minimum, at most maximum. n: number of samples, in words; has_enough: of them."""

    bar: str
    name: str
    value: float
    low: float
    high: float
    n: str
    minimum: float = -math.inf
    maximum: float = math.inf
    has_enough: bool = True

    @property
    def verdict(self) -> str:
        """Return met, not met or inconclusive."""
        if not self.has_enough or any(map(math.isnan, (self.value, self.low, self.high))):
            return "inconclusive"
        if self.low >= self.minimum and self.high <= self.maximum:
            return "met"
        return "not met" if self.high < self.minimum or self.low > self.maximum else "inconclusive"

    @property
    def bound(self) -> str:
        """Format the bound."""
        return f">= {self.minimum:g}" if math.isfinite(self.minimum) else f"<= {self.maximum:g}"

    @property
    def spread(self) -> str:
        """Format the value with its interval."""
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"

    def __str__(self) -> str:
        return f"{self.verdict:12}  bar {self.bar}  {self.name}: {self.spread}, n = {self.n}; bar {self.bound}"


def measure_attacks(rows: list[dict[str, Any]]) -> Iterator[Measured]:
    """Yield bars 1, 2, 4 and 5 of the rows of the study attacks."""
    for row in rows:
        name = f"{row['method']}, {row['attack']} x{row['num_malicious']}, {row['defence']}"
        scenarios = row["num_scenarios"]
        if row["defence"] in (NO_DEFENCE, ORACLE):
            continue
        if row["attack"] == NO_ATTACK:
            yield _difference("1", f"{name}: clean cost", row["vs_clean"], scenarios, minimum=-MAX_CLEAN_COST)
            continue
        if row["attack"] not in COLLUDING:
            yield _difference(
                "1", f"{name}: defended - oracle", row["vs_oracle"], scenarios, minimum=-MAX_LOSS_TO_ORACLE
            )
        yield _difference(
            "5" if row["attack"] in COLLUDING else "1", f"{name}: defended - alone", row["vs_alone"], scenarios, 0.0
        )
        for proportion, minimum, text in zip(row["named_checkable"], (MIN_NAMED_5, MIN_NAMED_10), ("5", "10")):
            if proportion["total"]:
                yield _proportion("2", f"{name}: checkable, named within {text} frames", proportion, minimum)
        for proportion, minimum, text in zip(row["named_by_ego"], (MIN_NAMED_5, MIN_NAMED_10), ("5", "10")):
            if proportion["total"] and proportion["total"] < row["named_checkable"][0]["total"]:
                name_of = f"{name}: of these, checkable by the ego itself, named within {text} frames"
                yield _proportion("2", name_of, proportion, minimum)
        if row["attack"] in PERSISTENT_SEEN and row["named"][0]["total"]:
            yield _proportion("2", f"{name}: on seen road, named within 5 frames", row["named"][0], MIN_NAMED_SEEN)
        if row["attack"] in COLLUDING and row["named"][1]["total"]:
            yield _proportion("5", f"{name}: named within 10 frames", row["named"][1], MIN_NAMED_COLLUDING)
        surviving = row["blind"]["surviving"]
        if surviving["successes"]:
            yield _proportion("4", f"{name}: surviving uncheckable claims marked as such", row["blind"]["marked"], 1.0)
            yield _proportion("4", f"{name}: those of senders with trust >= 0.8", row["blind"]["trusted"], 1.0)


def measure_accusations(rows: list[dict[str, Any]]) -> Iterator[Measured]:
    """Yield bar 3 of the rows of the study false-accusations."""
    for row in rows:
        rate = row["accusations"]
        value = rate["events"] / rate["minutes"] if rate["minutes"] else math.nan
        n = f"{rate['minutes']:.1f} sender-minutes, {rate['events']} accusations"
        if rate["minutes"] < MIN_SENDER_MINUTES:
            n += f"; {MIN_SENDER_MINUTES:g} are asked"
        upper = math.nan if rate["upper"] is None else rate["upper"]
        yield Measured(
            "3", f"{row['variant']}, {row['defence']}", value, rate["low"], upper, n, maximum=MAX_ACCUSATION_RATE
        )


def _difference(bar: str, name: str, pair: list[dict[str, Any]] | None, scenarios: int, minimum: float) -> Measured:
    n, has_enough = f"{scenarios} scenarios", scenarios >= MIN_SCENARIOS
    if pair is None:
        return Measured(bar, f"{name}, AP@0.5", math.nan, math.nan, math.nan, n, minimum)
    values = [math.nan if pair[0][key] is None else pair[0][key] for key in ("value", "low", "high")]
    return Measured(bar, f"{name}, AP@0.5", values[0], values[1], values[2], n, minimum, has_enough=has_enough)


def _proportion(bar: str, name: str, stored: dict[str, Any], minimum: float) -> Measured:
    value = stored["successes"] / stored["total"] if stored["total"] else math.nan
    n = f"{stored['successes']} of {stored['total']}"
    # Where every one of them is asked for, the observed fraction decides.
    low = value if minimum == 1.0 else stored["low"]
    return Measured(bar, name, value, low, value if minimum == 1.0 else stored["high"], n, minimum)


@dataclass(frozen=True)
class Options:
    """Results of the studies attacks and false-accusations, and where the table goes."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """JSON of the studies."""
    out: Path | None = None
    """Write the bars as JSON, for 'manyeyes report docs'."""


def make_table(measured: Sequence[Measured]) -> StudyTable:
    """Tabulate the bars."""
    headings = ("bar", "quantity", "value [95 % CI]", "n", "bound", "verdict")
    lines = tuple((m.bar, m.name, m.spread, m.n, m.bound, m.verdict) for m in measured)
    return StudyTable("Bars of misbehaviour detection", headings, lines)


def main(options: Options) -> int:
    """Print all bars; the exit code is 1 where one is not met."""
    measured, splits = list[Measured](), list[str]()
    for path in options.results:
        stored = json.loads(path.read_text(encoding="utf-8"))
        accuses = stored["result"]["study"] == "false-accusations"
        measured += (measure_accusations if accuses else measure_attacks)(stored["result"]["rows"])
        if not accuses:
            splits.append(stored["provenance"]["config"]["options"]["split"])
    measured.sort(key=lambda one: one.bar)
    sys.stdout.write("".join(f"{one}\n" for one in measured))
    sys.stdout.write("bar 6 is a test: tests/runtime/test_outsiders.py\n")
    if options.out is not None:
        table = make_table(measured)
        result = {
            "study": "attack-bars",
            "split": ", ".join(dict.fromkeys(splits)),
            "rows": measured,
            "tables": [table],
        }
        provenance.write_json(options.out, result, options, 0)
    return int(any(one.verdict == "not met" for one in measured))


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options)))
