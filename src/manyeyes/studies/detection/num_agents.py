# SPDX-License-Identifier: Apache-2.0
"""What each further agent brings: the ego with the nearest so many others, one to five in all.

A row of n agents is judged on the scenarios that have as many, against the truth of everybody that is there; what it gains over
one agent fewer and over ego alone is judged on those same scenarios.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.average_precision import protocol_named
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import Condition, Place, Sweep
from manyeyes.studies.running import ALONE, carry_out, publish, start
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

MOST = 5


@dataclass(frozen=True)
class Row:
    """A method with so many agents, on as many scenarios as have them. instant_bytes: of all senders together, mean."""

    agents: int
    method: str
    scenarios: int
    ap: tuple[Interval, Interval]
    over_one_fewer: Interval | None
    over_alone: Interval | None
    bytes_per_message: float
    instant_bytes: float


def run(options: Options, console: Console) -> None:
    """The study."""
    if protocol_named(options.protocol).min_points_in_gt:
        raise ConfigError(f"The study 'agents' cannot count points in true boxes, as protocol {options.protocol} does.")
    begun = start(options, console)
    recording, methods = begun.opener(), begun.base.methods
    most = min(MOST, max(len(recording.agents(name)) for name in recording.scenarios))
    hearing = tuple(m for m in methods if m != ALONE)
    conditions = [
        Condition(str(n), replace(begun.base, agents=n, methods=methods if n == 1 else hearing))
        for n in range(1, most + 1)
        if n == 1 or hearing
    ]
    done = carry_out(begun, conditions)
    table = rows(done)
    publish(begun, {"rows": table}, [_sheet(table)], panels(table), conditions)


def rows(done: Sweep) -> tuple[Row, ...]:
    """The table, by number of agents."""
    return tuple(_row(done, int(name), method) for name, method in done.cells)


def _row(done: Sweep, agents: int, method: str) -> Row:
    place, fewer, alone = (str(agents), method), (str(agents - 1), method), ("1", ALONE)
    cell, here = done.cells[place], done.scenarios(place)

    def over(other: Place) -> Interval | None:
        return done.less(place, other, 0, here) if other in done.cells and other != place else None

    return Row(
        agents,
        method,
        len(here),
        (done.ap(place, 0), done.ap(place, 1)),
        over(fewer),
        over(alone),
        cell.bytes_per_message,
        cell.volume.instant_mean,
    )


def _sheet(table: Sequence[Row]) -> Sheet:
    headings = (
        "agents", "method", "scenarios", "AP@0.5", "AP@0.7", "over one fewer @0.5", "over alone @0.5", "bytes/message",
        "bytes/instant",
    )  # fmt: skip
    lines = tuple(
        (
            str(row.agents),
            row.method,
            str(row.scenarios),
            *map(value, row.ap),
            change(row.over_one_fewer),
            change(row.over_alone),
            number(row.bytes_per_message),
            number(row.instant_bytes),
        )
        for row in table
    )
    return Sheet("Agents", headings, lines)


def panels(table: Sequence[Row]) -> list[Panel]:
    """AP by number of agents on all scenarios that have them, and what that is over ego alone on the same scenarios."""
    methods = [m for m in dict.fromkeys(row.method for row in table) if m != ALONE]
    whole, gain = [], []
    for method in methods:
        own = [row for row in table if row.method == method]
        whole.append(Curve(method, tuple(r.ap[0] for r in own), tuple(float(r.agents) for r in own)))
        over = [(r.over_alone, float(r.agents)) for r in own if r.over_alone is not None]
        if over:
            gain.append(Curve(method, tuple(y for y, _ in over), tuple(x for _, x in over)))
    out = [Panel("Scenarios that have them", "agents", "AP@0.5", tuple(whole))] if whole else []
    return out + ([Panel("The same scenarios", "agents", "AP@0.5 over ego alone", tuple(gain))] if gain else [])
