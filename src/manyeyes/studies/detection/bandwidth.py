# SPDX-License-Identifier: Apache-2.0
"""AP against bytes a message, for each way to choose tokens and each way to write them: CoSTr, Fig. 3.

Bytes are those handed to the bus: headers, indices, scales, checksums and all, mean over messages. The budget of a message goes
down to one packet. "all" is every token that the trained pruning left; at float32 it is what the others are held against.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manyeyes.comms.payloads import PRECISIONS
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import loaded
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.significance import Claim, claim
from manyeyes.evaluation.study import Condition, Sweep
from manyeyes.studies.running import (
    ALONE,
    OURS,
    carry_out,
    claims_sheet,
    publish,
    selectors,
    start,
    with_replay,
)
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, log2, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

BUDGETS = (1398, 2796, 4096, 8192, 16384, 32768, 65536, 131072)
REFERENCES, WHOLE, CODES = "references", "float32", "codes"
THREE_PACKETS, FEWER = 4096, 4.7


@dataclass(frozen=True)
class Row:
    """Tokens chosen and written in one way within a budget, None: all. lost: AP less than with all tokens at float32.

    bytes_per_message: mean; largest: of one message. fewer: how many times fewer bytes than all tokens at float32.
    """

    budget_bytes: int | None
    precision: str
    selector: str
    ap: tuple[Interval, Interval]
    lost: tuple[Interval, Interval] | None
    bytes_per_message: float
    largest: int
    fewer: float | None


def run(options: Options, console: Console) -> None:
    """The study."""
    begun, chosen = start(options, console), selectors(options)
    precisions = _precisions(options)
    budgets = (*sorted(options.budgets or BUDGETS), None)
    others = tuple(m for m in begun.base.methods if m not in chosen)
    conditions = [
        Condition(_name(b, p), with_replay(replace(begun.base, methods=chosen), precision=p, budget_bytes=b))
        for p in precisions
        for b in budgets
    ]
    if WHOLE not in precisions:
        config = with_replay(replace(begun.base, methods=chosen), precision=WHOLE, budget_bytes=None)
        conditions.append(Condition(_name(None, WHOLE), config))
    if others:
        conditions.append(Condition(REFERENCES, replace(begun.base, methods=others)))
    done = carry_out(begun, conditions)
    table = rows(done, precisions, budgets, chosen)
    beside = tuple(
        Row(None, "", m, (done.ap((REFERENCES, m), 0), done.ap((REFERENCES, m), 1)), None,
            done.cells[REFERENCES, m].bytes_per_message, done.cells[REFERENCES, m].volume.largest, None)
        for m in others
    )  # fmt: skip
    held = claims(done, table, precisions, budgets, chosen)
    sheets = [_sheet(f"Tokens as {p}", [row for row in table if row.precision == p]) for p in precisions]
    sheets += [_sheet("Beside", beside)] if beside else []
    sheets += [claims_sheet(held)] if held else []
    payload: dict[str, object] = {"rows": table, "beside": beside, "claims": held}
    publish(begun, payload, sheets, panels(table, beside), conditions)


def _precisions(options: Options) -> tuple[str, ...]:
    """Those asked for, or all that the weights can write: codes need a codebook."""
    for name in options.precisions:
        if name not in PRECISIONS:
            raise ConfigError(f"Tokens are not written as {name!r}; known: {', '.join(PRECISIONS)}.")
    has_codes = loaded(options.playing.weights).codebook is not None
    return options.precisions or tuple(name for name in PRECISIONS if name != CODES or has_codes)


def _name(budget: int | None, precision: str) -> str:
    return f"{'all' if budget is None else budget} {precision}"


def rows(
    done: Sweep, precisions: Sequence[str], budgets: Sequence[int | None], chosen: Sequence[str]
) -> tuple[Row, ...]:
    """The table: precisions, budgets, selectors."""
    out = []
    for precision in precisions:
        for budget in budgets:
            for selector in chosen:
                place, whole = (_name(budget, precision), selector), (_name(None, WHOLE), selector)
                cell, all_of_it = done.cells[place], done.cells[whole]
                sent = cell.bytes_per_message
                out.append(
                    Row(
                        budget,
                        precision,
                        selector,
                        (done.ap(place, 0), done.ap(place, 1)),
                        (done.less(whole, place, 0), done.less(whole, place, 1)),
                        sent,
                        cell.volume.largest,
                        all_of_it.bytes_per_message / sent if sent else None,
                    )
                )
    return tuple(out)


def claims(
    done: Sweep,
    table: Sequence[Row],
    precisions: Sequence[str],
    budgets: Sequence[int | None],
    chosen: Sequence[str],
) -> tuple[Claim, ...]:
    """What is claimed of our selection: little lost at few bytes, never worse than a rival at equal budgets."""
    if OURS not in chosen:
        return ()
    out: list[Claim] = []
    whole = (_name(None, WHOLE), OURS)
    few = [r for r in table if r.selector == OURS and r.precision == WHOLE and r.fewer and r.fewer >= FEWER]
    if few:
        most = max(few, key=lambda row: row.bytes_per_message)
        what = f"{most.fewer:.1f} times fewer bytes - all, {WHOLE}"
        out.append(claim(what, done, (_name(most.budget_bytes, WHOLE), OURS), whole, 0, -0.005))
    short = [p for p in precisions if p not in ("float32", "float16")]
    if THREE_PACKETS in budgets:
        for p in short:
            out.append(
                claim(
                    f"{THREE_PACKETS} B as {p} - all, {WHOLE}", done, (_name(THREE_PACKETS, p), OURS), whole, 0, -0.01
                )
            )
    for precision in precisions:
        for budget in (b for b in budgets if b is not None):
            for rival in (s for s in chosen if s != OURS):
                name = _name(budget, precision)
                out.append(claim(f"{OURS} - {rival}, {name}", done, (name, OURS), (name, rival), 0, 0.0))
    return tuple(out)


def _sheet(title: str, table: Sequence[Row]) -> Sheet:
    headings = (
        "budget B", "selector", "AP@0.5", "AP@0.7", "lost @0.5", "lost @0.7", "bytes/message", "AB log2", "largest B", "fewer",
    )  # fmt: skip
    lines = tuple(
        (
            "" if not row.precision else "all" if row.budget_bytes is None else f"{row.budget_bytes:,}",
            row.selector,
            *map(value, row.ap),
            *(map(change, row.lost) if row.lost else ("", "")),
            number(row.bytes_per_message),
            log2(row.bytes_per_message),
            number(row.largest),
            "" if row.fewer is None else f"{row.fewer:.1f} x",
        )
        for row in table
    )
    return Sheet(title, headings, lines)


def panels(table: Sequence[Row], beside: Sequence[Row]) -> list[Panel]:
    """AP@0.5 against the mean bytes of a message, a panel a precision."""
    out = []
    for precision in dict.fromkeys(row.precision for row in table):
        curves = []
        for selector in dict.fromkeys(row.selector for row in table):
            own = [r for r in table if (r.precision, r.selector) == (precision, selector) and r.bytes_per_message]
            if own:
                curves.append(Curve(selector, tuple(r.ap[0] for r in own), tuple(r.bytes_per_message for r in own)))
        for row in beside:
            sent = (row.bytes_per_message,) if row.bytes_per_message and row.selector != ALONE else ()
            curves.append(Curve(row.selector, (row.ap[0],), sent))
        out.append(Panel(f"Tokens as {precision}", "bytes a message, mean", "AP@0.5", tuple(curves), in_bytes=True))
    return out
