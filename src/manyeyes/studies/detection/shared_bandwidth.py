# SPDX-License-Identifier: Apache-2.0
"""The system as a whole: every agent judged as ego in turn, all senders within one budget of the channel (CoSTr, Eq. 2).

What is maximised is the AP of all egos together, their detections in one list. What one sender does not need of its part goes
to the others (comms/bandwidth.py). A broadcast is heard by everybody and counted once. The largest budget is what 27 Mbit/s
carry in 100 ms. Ways of collaboration that know no budget stand beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.study import Condition, Sweep
from manyeyes.studies.running import ALONE, carry_out, publish, selectors, start, with_replay
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

BUDGETS = (8192, 16384, 65536, 337_500)
UNBOUND = "no budget"


@dataclass(frozen=True)
class Row:
    """A method with all agents as egos, their messages of an instant together within the budget. most: of an instant."""

    budget_bytes: int | None
    method: str
    ego_frames: int
    ap: tuple[Interval, Interval]
    over_alone: Interval | None
    instant_bytes: float
    most: int


def run(options: Options, console: Console) -> None:
    """The study."""
    begun, chosen = start(options, console, all_egos=True), selectors(options)
    others = tuple(m for m in begun.base.methods if m not in chosen)
    conditions = [
        Condition(str(b), with_replay(replace(begun.base, methods=chosen), channel_bytes=b))
        for b in sorted(options.budgets or BUDGETS)
    ]
    if others:
        conditions.append(Condition(UNBOUND, replace(begun.base, methods=others)))
    done = carry_out(begun, conditions)
    table = rows(done)
    publish(begun, {"rows": table}, [_sheet(table)], panels(table), conditions)


def rows(done: Sweep) -> tuple[Row, ...]:
    """The table, by budget."""
    alone = (UNBOUND, ALONE)
    out = []
    for place, cell in done.cells.items():
        name, method = place
        out.append(
            Row(
                None if name == UNBOUND else int(name),
                method,
                len(cell.matches[0]),
                (done.ap(place, 0), done.ap(place, 1)),
                done.less(place, alone, 0) if alone in done.cells and place != alone else None,
                cell.volume.instant_mean,
                cell.volume.instant_most,
            )
        )
    return tuple(out)


def _sheet(table: Sequence[Row]) -> Sheet:
    headings = (
        "budget B/instant",
        "method",
        "ego frames",
        "AP@0.5",
        "AP@0.7",
        "over alone @0.5",
        "bytes/instant",
        "most",
    )
    lines = tuple(
        (
            UNBOUND if row.budget_bytes is None else f"{row.budget_bytes:,}",
            row.method,
            f"{row.ego_frames:,}",
            *map(value, row.ap),
            change(row.over_alone),
            number(row.instant_bytes),
            number(row.most),
        )
        for row in table
    )
    return Sheet("Every agent as ego", headings, lines)


def panels(table: Sequence[Row]) -> list[Panel]:
    """AP@0.5 of all egos against the mean bytes of an instant."""
    curves = []
    for method in dict.fromkeys(row.method for row in table):
        own = [row for row in table if row.method == method]
        x = tuple(row.instant_bytes for row in own) if all(row.instant_bytes for row in own) else ()
        curves.append(Curve(method, tuple(row.ap[0] for row in own), x))
    return [Panel("Every agent as ego", "bytes an instant, all senders, mean", "AP@0.5", tuple(curves), in_bytes=True)]
