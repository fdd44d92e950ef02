# SPDX-License-Identifier: Apache-2.0
"""Numbers of maps as tables, for the terminal and for Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.table import Table

from manyeyes.evaluation.maps.adversarial import AdversarialResult
from manyeyes.evaluation.maps.change_summary import KindChange
from manyeyes.evaluation.maps.map_cells import ApRow, KindRow
from manyeyes.evaluation.maps.study import MethodSummary, StudyMarginTest
from manyeyes.viz.table import format_markdown_lines

HEADINGS = (
    "method", "AP ped", "AP div", "mAP exact", "mAP maptr", "mAP smn, wide", "F@0.5 div", "dup", "frag", "lat m", "end m", "s",
)  # fmt: skip
MARGIN_HEADINGS = ("margin test", "baseline", "value", "95 % interval", "at least", "verdict")


def make_kinds_table(ap: Sequence[ApRow], kinds: Sequence[KindRow], title: str) -> Table:
    """One map: a row a kind that is predicted or true."""
    table = _make_table(
        title, ("kind", "AP exact", "AP maptr", "AP smn", "F .3", "F .5", "F 1", "dup", "frag", "lat m", "n")
    )
    by_protocol = {row.protocol: row for row in ap if row.thresholds == "narrow"}
    for k in kinds:
        if k.n_predicted or k.n_truth:
            aps = [
                _format_number(getattr(by_protocol[protocol], k.kind))
                for protocol in ("exact", "maptr", "streammapnet")
            ]
            rest = [
                _format_number(k.duplication, 2),
                _format_number(k.fragmentation, 2),
                _format_number(k.lateral_median_m, 2),
            ]
            table.add_row(k.kind, *aps, *(_format_number(f) for f in k.f1), *rest, f"{k.n_predicted}/{k.n_truth}")
    table.add_row(
        "mAP",
        *(_format_number(by_protocol[protocol].mean_ap) for protocol in ("exact", "maptr", "streammapnet")),
        *[""] * 7,
    )
    return table


def make_change_table(changes: Sequence[KindChange], title: str) -> Table:
    """What changed, a row a kind that changed or stayed."""
    table = _make_table(title, ("kind", "kept", "changed", "added", "removed", "new m", "gone m"))
    for c in changes:
        counts = (c.num_unchanged, c.num_changed, c.num_added, c.num_removed)
        if any(counts):
            table.add_row(c.kind, *map(str, counts), f"{c.added_length_m:.0f}", f"{c.removed_length_m:.0f}")
    return table


def make_study_table(summaries: Sequence[MethodSummary], group: str) -> Table:
    """One group of a study."""
    table = _make_table(group, HEADINGS)
    for summary in summaries:
        if summary.group == group:
            table.add_row(*_summary_cells(summary))
    return table


def make_margin_table(margin_tests: Sequence[StudyMarginTest]) -> Table:
    """Tabulate margin tests with values and verdicts."""
    table = _make_table("Bars", ("group", *MARGIN_HEADINGS))
    for margin_test in margin_tests:
        table.add_row(margin_test.group, *_margin_cells(margin_test))
    return table


def format_study(title: str, summaries: Sequence[MethodSummary], margin_tests: Sequence[StudyMarginTest]) -> str:
    """A study as a document."""
    out = [f"# {title}", ""]
    for group in dict.fromkeys(summary.group for summary in summaries):
        group_summaries = [summary for summary in summaries if summary.group == group]
        out += [
            f"## {group}, {group_summaries[0].num_results} cells",
            "",
            format_markdown_lines([HEADINGS, *map(_summary_cells, group_summaries)]),
        ]
        group_tests = [test for test in margin_tests if test.group == group]
        if group_tests:
            out += [format_markdown_lines([MARGIN_HEADINGS, *map(_margin_cells, group_tests)])]
    return "\n".join(out)


ADVERSARIAL_HEADINGS = (
    "place",
    "seed",
    "malicious",
    "offset m",
    "stations",
    "moved > 0.1 m",
    "lost",
    "moved by truth",
    "p99 m",
    "largest m",
)


def make_adversarial_table(results: Sequence[AdversarialResult]) -> Table:
    """Tabulate displacements by malicious agents."""
    table = _make_table(
        "Stations observed by five or more agents: displacement by malicious agents", ADVERSARIAL_HEADINGS
    )
    for result in results:
        table.add_row(*_adversarial_cells(result))
    return table


def format_adversarial(results: Sequence[AdversarialResult]) -> str:
    """The same as a document."""
    return "# Malicious agents\n\n" + format_markdown_lines([ADVERSARIAL_HEADINGS, *map(_adversarial_cells, results)])


def _adversarial_cells(result: AdversarialResult) -> tuple[str, ...]:
    counts = (
        str(result.num_stations),
        str(result.num_displaced),
        str(result.num_lost),
        str(result.num_displaced_without_attack),
    )
    attackers = f"{result.num_malicious} of {result.num_observations}, {result.attack}"
    return (
        result.place,
        str(result.seed),
        attackers,
        f"{result.offset_m:g}",
        *counts,
        _format_number(result.p99_m),
        _format_number(result.max_m),
    )


def _summary_cells(summary: MethodSummary) -> tuple[str, ...]:
    mean = f"{summary.mean_ap.value:.3f} [{summary.mean_ap.low:.3f}, {summary.mean_ap.high:.3f}]"
    numbers = (summary.maptr, summary.streammapnet, summary.f1)
    rest = (summary.duplication, summary.fragmentation, summary.lateral_error_m, summary.endpoint_error_m)
    return (
        summary.method,
        _format_number(summary.crossing),
        _format_number(summary.divider),
        mean,
        *map(_format_number, numbers),
        *(_format_number(value, 2) for value in rest),
        _format_number(summary.seconds, 1),
    )


def _margin_cells(margin_test: StudyMarginTest) -> tuple[str, ...]:
    interval = f"[{margin_test.low:.3f}, {margin_test.high:.3f}]"
    return (
        margin_test.description,
        margin_test.baseline,
        f"{margin_test.value:.3f}",
        interval,
        f"{margin_test.margin:.3f}",
        margin_test.verdict,
    )


def _make_table(title: str, headings: Sequence[str]) -> Table:
    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.padding = (0, 1, 0, 0)
    for column, heading in enumerate(headings):
        table.add_column(heading.replace(" ", "\n"), justify="right" if column else "left", no_wrap=True)
    return table


def _format_number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
