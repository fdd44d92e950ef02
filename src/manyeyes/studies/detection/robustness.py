# SPDX-License-Identifier: Apache-2.0
"""How much delay, errors of pose and lost packets cost each method: CoSTr, Table II, with loss and all together beside.

Oracle rows tell what is lost to geometry from what is lost to the model: of each joint disturbance, the row with true poses has
its delay and loss alone, the row without delay its errors of pose alone. Early fusion is the bound. Ego alone hears nobody,
hence is the same under every disturbance: it is played once. --branches name=weights.safetensors plays rival fusions beside, such
as the ablation's branches; for a fair race --weights is then the branch of as many steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manyeyes.agents.strategies import METHODS
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.significance import Claim, claim
from manyeyes.evaluation.study import Condition, Place, Sweep
from manyeyes.studies.detection.ablation import branches_of
from manyeyes.studies.detection.perturbations import (
    DELAYS,
    HARD,
    HEADINGS,
    JOINT,
    LOSSES,
    PERFECT,
    POSITIONS,
    Disturbance,
    chosen,
)
from manyeyes.studies.running import ALONE, BOUND, OURS, PAPER, carry_out, claims_sheet, publish, start
from manyeyes.viz.curves import Curve, Panel
from manyeyes.viz.study_table import Sheet, change, number, value

if TYPE_CHECKING:
    from rich.console import Console

    from manyeyes.studies.options import Options

ORACLES = {
    replace(JOINT, heading_deg=0, position_m=0): "true poses",
    replace(JOINT, delay_s=0): "no delay",
    replace(HARD, heading_deg=0, position_m=0): "true poses",
    replace(HARD, delay_s=0): "no delay",
}
TOGETHER = (JOINT, *list(ORACLES)[:2], HARD, *list(ORACLES)[2:])
ALL = (PERFECT, *DELAYS, *HEADINGS, *POSITIONS, *LOSSES, *(d for d in TOGETHER if d not in DELAYS))
SPEEDS = {"still": (0.0, 0.1), "below 5 m/s": (0.1, 5.0), "from 5 m/s": (5.0, math.inf)}
LOSES_AT_MOST = {DELAYS[-1]: 0.037, HEADINGS[-1]: 0.054, POSITIONS[-1]: 0.044, LOSSES[-1]: 0.03}
PAPER_AP50 = {
    PERFECT: 0.946,
    **dict(zip(DELAYS, (0.937, 0.928, 0.917, 0.909))),
    **dict(zip(HEADINGS, (0.937, 0.921, 0.904, 0.892))),
    **dict(zip(POSITIONS, (0.941, 0.926, 0.913, 0.902))),
}


@dataclass(frozen=True)
class Row:
    """A method under a disturbance. lost: AP less than without any; over_alone: more than ego alone; two IoUs each.

    by_speed: AP@0.5 of each class of SPEEDS, where messages are late. paper: CoSTr's own AP@0.5.
    """

    disturbance: Disturbance
    oracle: str
    method: str
    ap: tuple[Interval, Interval]
    lost: tuple[Interval, Interval]
    over_alone: tuple[Interval, Interval] | None
    bytes_per_message: float
    age_ms: float
    by_speed: tuple[Interval, ...]
    paper: float | None


def run(options: Options, console: Console) -> None:
    """The study."""
    begun = start(options, console)
    methods = begun.base.methods
    hearing = tuple(m for m in methods if m != ALONE)
    conditions = [
        Condition(d.name, d.on(replace(begun.base, methods=methods if d == PERFECT else hearing)))
        for d in chosen(options.disturbances, ALL)
        if d == PERFECT or hearing
    ]
    rivals = branches_of(options.branches, "robustness") if options.branches else {}
    if taken := sorted(set(rivals) & set(METHODS)):
        raise ConfigError(
            f"The study 'robustness' has methods of the names {', '.join(taken)}; call these branches otherwise."
        )
    for rival, weights in rivals.items():
        base = replace(begun.base, methods=(OURS,), weights=weights)
        conditions += [Condition(_place(d, rival, (rival,))[0], d.on(base)) for d in chosen(options.disturbances, ALL)]
    done = carry_out(begun, conditions)
    table, held = rows(done, tuple(rivals)), claims(done, tuple(rivals))
    sheets = [
        _sheet(title, table, group)
        for title, group in (
            ("Delay", DELAYS),
            ("Heading", HEADINGS),
            ("Position", POSITIONS),
            ("Lost packets", LOSSES),
            ("Together", TOGETHER),
        )
        if any(row.disturbance in group for row in table)
    ]
    payload: dict[str, object] = {"rows": table, "claims": held, "paper": PAPER}
    publish(begun, payload, [*sheets, claims_sheet(held)], panels(table), conditions, (PAPER,))


def _place(disturbance: Disturbance, method: str, rivals: Sequence[str]) -> Place:
    """Where a method, or a rival's weights, lies in the sweep."""
    return (f"{method}: {disturbance.name}", OURS) if method in rivals else (disturbance.name, method)


def rows(done: Sweep, rivals: Sequence[str] = ()) -> tuple[Row, ...]:
    """The table, a disturbance after the other."""
    return tuple(
        _row(done, d, method, rivals)
        for d in ALL
        for method in (*(m for name, m in done.cells if name == d.name), *rivals)
        if _place(d, method, rivals) in done.cells
    )


def _row(done: Sweep, disturbance: Disturbance, method: str, rivals: Sequence[str]) -> Row:
    place, perfect = (_place(d, method, rivals) for d in (disturbance, PERFECT))
    alone = (PERFECT.name, ALONE)
    cell = done.cells[place]
    late = disturbance == PERFECT or disturbance.delay_s > 0
    return Row(
        disturbance,
        ORACLES.get(disturbance, ""),
        method,
        (done.ap(place, 0), done.ap(place, 1)),
        (done.less(perfect, place, 0), done.less(perfect, place, 1)),
        (done.less(place, alone, 0), done.less(place, alone, 1)) if alone in done.cells and method != ALONE else None,
        cell.bytes_per_message,
        cell.age_ms,
        tuple(done.ap(place, 0, speeds) for speeds in SPEEDS.values()) if late else (),
        PAPER_AP50.get(disturbance) if method == OURS else None,
    )


def claims(done: Sweep, branches: Sequence[str] = ()) -> tuple[Claim, ...]:
    """What is claimed of the project's own method: better than every other but the bound everywhere, and little lost."""
    if (PERFECT.name, OURS) not in done.cells:
        return ()
    rivals = [method for name, method in done.cells if name == PERFECT.name and method not in (OURS, BOUND)]
    rivals += branches
    out = []
    played = [d for d in ALL if (d.name, OURS) in done.cells]
    for disturbance in played:
        for rival in rivals:
            other = _place(PERFECT if rival == ALONE else disturbance, rival, branches)
            what = f"{OURS} - {rival}, {disturbance.name}"
            out += [claim(what, done, (disturbance.name, OURS), other, iou, 0.0) for iou in (0, 1)]
    for disturbance, most in ((d, LOSES_AT_MOST[d]) for d in played if d in LOSES_AT_MOST):
        what = f"{OURS}, {disturbance.name} - {PERFECT.name}"
        out.append(claim(what, done, (disturbance.name, OURS), (PERFECT.name, OURS), 0, -most))
    return tuple(out)


def _sheet(title: str, table: Sequence[Row], group: Sequence[Disturbance]) -> Sheet:
    """One kind of disturbance, the perfect setting on top; the word for an oracle row where it is one."""
    table = [row for row in table if row.disturbance in (PERFECT, *group)]
    headings = (
        "disturbance",
        "method",
        "AP@0.5",
        "AP@0.7",
        "lost @0.5",
        "lost @0.7",
        "over alone @0.5",
        "bytes/message",
        "age ms",
    )
    speeds = any(row.by_speed for row in table if row.disturbance != PERFECT)
    lines = []
    for row in table:
        name = row.disturbance.name + (f" ({row.oracle})" if row.oracle and JOINT in group else "")
        plain = row.disturbance == PERFECT
        line = (
            name,
            row.method,
            *map(value, row.ap),
            *("" if plain else change(lost) for lost in row.lost),
            change(row.over_alone[0]) if row.over_alone else "",
            number(row.bytes_per_message),
            number(row.age_ms),
        )
        by_speed = tuple(value(v) for v in row.by_speed) or ("",) * len(SPEEDS)
        paper = "" if row.paper is None else f"{row.paper:.3f}"
        lines.append((*line, *(by_speed if speeds else ()), paper))
    more = tuple(f"AP@0.5 {name}" for name in SPEEDS) if speeds else ()
    return Sheet(title, (*headings, *more, "paper"), tuple(lines))


def panels(table: Sequence[Row]) -> list[Panel]:
    """AP@0.5 against each disturbance by itself, and a panel of the joint ones."""
    by_place = {(row.disturbance, row.method): row.ap[0] for row in table}
    methods = list(dict.fromkeys(row.method for row in table))
    out = []
    for title, xlabel, group, level in (
        ("Delay", "seconds", DELAYS, "delay_s"),
        ("Heading", "standard deviation, degrees", HEADINGS, "heading_deg"),
        ("Position", "standard deviation, m", POSITIONS, "position_m"),
        ("Lost packets", "share", LOSSES, "loss"),
    ):
        levels = (PERFECT, *group)
        x = tuple(getattr(d, level) for d in levels)
        curves = (_curve(m, [by_place.get((d, m)) for d in levels], x) for m in methods)
        out.append(Panel(title, xlabel, "AP@0.5", tuple(c for c in curves if c)))
    x, levels = tuple(map(float, range(3))), (PERFECT, JOINT, HARD)
    curves = (_curve(m, [by_place.get((d, m)) for d in levels], x) for m in methods)
    out.append(Panel("Together", "", "AP@0.5", tuple(c for c in curves if c), ticks=tuple(d.name for d in levels)))
    return out


def _curve(method: str, y: Sequence[Interval | None], x: tuple[float, ...]) -> Curve | None:
    """A line through the levels that were played, a level where one alone was: ego alone."""
    known = [(v, at) for v, at in zip(y, x) if v is not None]
    values = tuple(v for v, _ in known)
    if len(known) > 1:
        return Curve(method, values, tuple(at for _, at in known))
    return Curve(method, values) if known else None
