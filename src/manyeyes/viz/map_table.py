# SPDX-License-Identifier: Apache-2.0
"""Numbers of maps as tables, for the terminal and for Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.table import Table

from manyeyes.evaluation.maps.adversarial import Malice
from manyeyes.evaluation.maps.change_summary import KindChange
from manyeyes.evaluation.maps.map_cells import ApRow, KindRow
from manyeyes.evaluation.maps.study import Line, Verdict
from manyeyes.viz.table import markdown_lines

HEADINGS = (
    "method", "AP ped", "AP div", "mAP exact", "mAP maptr", "mAP smn, wide", "F@0.5 div", "dup", "frag", "lat m", "end m", "s",
)  # fmt: skip
VERDICT_HEADINGS = ("bar", "rival", "value", "95 % interval", "at least", "verdict")


def kinds_terminal(ap: Sequence[ApRow], kinds: Sequence[KindRow], title: str) -> Table:
    """One map: a row a kind that is predicted or true."""
    table = _table(
        title, ("kind", "AP exact", "AP maptr", "AP smn", "F .3", "F .5", "F 1", "dup", "frag", "lat m", "n")
    )
    by_way = {row.way: row for row in ap if row.thresholds == "narrow"}
    for k in kinds:
        if k.n_predicted or k.n_truth:
            aps = [_number(getattr(by_way[way], k.kind)) for way in ("exact", "maptr", "streammapnet")]
            rest = [_number(k.duplication, 2), _number(k.fragmentation, 2), _number(k.lateral_median_m, 2)]
            table.add_row(k.kind, *aps, *(_number(f) for f in k.f), *rest, f"{k.n_predicted}/{k.n_truth}")
    table.add_row("mAP", *(_number(by_way[way].mean) for way in ("exact", "maptr", "streammapnet")), *[""] * 7)
    return table


def change_terminal(changes: Sequence[KindChange], title: str) -> Table:
    """What changed, a row a kind that changed or stayed."""
    table = _table(title, ("kind", "kept", "changed", "added", "removed", "new m", "gone m"))
    for c in changes:
        counts = (c.kept, c.changed, c.added, c.removed)
        if any(counts):
            table.add_row(c.kind, *map(str, counts), f"{c.new_m:.0f}", f"{c.gone_m:.0f}")
    return table


def study_terminal(lines: Sequence[Line], group: str) -> Table:
    """One group of a study."""
    table = _table(group, HEADINGS)
    for line in lines:
        if line.group == group:
            table.add_row(*_cells(line))
    return table


def verdicts_terminal(verdicts: Sequence[Verdict]) -> Table:
    """The bars."""
    table = _table("Bars", ("group", *VERDICT_HEADINGS))
    for verdict in verdicts:
        table.add_row(verdict.group, *_verdict(verdict))
    return table


def study_markdown(title: str, lines: Sequence[Line], verdicts: Sequence[Verdict]) -> str:
    """A study as a document."""
    out = [f"# {title}", ""]
    for group in dict.fromkeys(line.group for line in lines):
        own = [line for line in lines if line.group == group]
        out += [f"## {group}, {own[0].cells} cells", "", markdown_lines([HEADINGS, *map(_cells, own)])]
        bars = [v for v in verdicts if v.group == group]
        if bars:
            out += [markdown_lines([VERDICT_HEADINGS, *map(_verdict, bars)])]
    return "\n".join(out)


MALICE_HEADINGS = (
    "place",
    "seed",
    "liars",
    "offset m",
    "stations",
    "moved > 0.1 m",
    "lost",
    "moved by truth",
    "p99 m",
    "largest m",
)


def malice_terminal(found: Sequence[Malice]) -> Table:
    """What liars moved."""
    table = _table("Stations that five or more agents saw, with liars against without", MALICE_HEADINGS)
    for trial in found:
        table.add_row(*_malice(trial))
    return table


def malice_markdown(found: Sequence[Malice]) -> str:
    """The same as a document."""
    return "# Malicious agents\n\n" + markdown_lines([MALICE_HEADINGS, *map(_malice, found)])


def _malice(m: Malice) -> tuple[str, ...]:
    counts = (str(m.stations), str(m.moved), str(m.lost), str(m.by_truth))
    liars = f"{m.malicious} of {m.observations}, {m.manner}"
    return m.place, str(m.seed), liars, f"{m.offset_m:g}", *counts, _number(m.p99_m), _number(m.largest_m)


def _cells(line: Line) -> tuple[str, ...]:
    mean = f"{line.mean.value:.3f} [{line.mean.low:.3f}, {line.mean.high:.3f}]"
    numbers = (line.maptr, line.streammapnet, line.f)
    rest = (line.duplication, line.fragmentation, line.lateral_m, line.end_error_m)
    return (
        line.method,
        _number(line.crossing),
        _number(line.divider),
        mean,
        *map(_number, numbers),
        *(_number(value, 2) for value in rest),
        _number(line.seconds, 1),
    )


def _verdict(v: Verdict) -> tuple[str, ...]:
    interval = f"[{v.low:.3f}, {v.high:.3f}]"
    return v.what, v.rival, f"{v.value:.3f}", interval, f"{v.bar:.3f}", v.word


def _table(title: str, headings: Sequence[str]) -> Table:
    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.padding = (0, 1, 0, 0)
    for place, heading in enumerate(headings):
        table.add_column(heading.replace(" ", "\n"), justify="right" if place else "left", no_wrap=True)
    return table


def _number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
