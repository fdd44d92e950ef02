# SPDX-License-Identifier: Apache-2.0
"""What a comparison of methods says: its rows, its paired differences, and the same as plain values for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console

from manyeyes.datasets.missing import NONE_MISSING, MissingFiles
from manyeyes.evaluation.detection.accumulator import IOUS, MethodResult
from manyeyes.evaluation.detection.average_precision import Protocol
from manyeyes.evaluation.detection.communication import Communication
from manyeyes.evaluation.statistics.bootstrap import Interval
from manyeyes.evaluation.statistics.comparison import Difference, differences
from manyeyes.viz.table import Row, differences_terminal, missing_footer, row_of, terminal

LARGEST_MESSAGE = 1 << 17
ALONE_BETWEEN = (0.50, 0.85)


@dataclass(frozen=True)
class Precision:
    """AP at one IoU threshold. ap is the protocol's own; recall and precision stand at its score threshold."""

    iou: float
    ap: Interval
    ap_global: float
    ap_legacy: float
    recall: float
    precision: float
    n_gt: int
    n_detections: int


@dataclass(frozen=True)
class Numbers:
    """All numbers of one method, without the frames behind them."""

    method: str
    precision: tuple[Precision, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float


@dataclass(frozen=True)
class Outcome:
    """A comparison, ready to be shown. protocol: whose rules AP follows, over which range. missing: files of the recording."""

    protocol: Protocol
    numbers: tuple[Numbers, ...]
    rows: tuple[Row, ...]
    differences: tuple[Difference, ...]
    checks: tuple[str, ...]
    missing: MissingFiles = NONE_MISSING

    @property
    def footer(self) -> str:
        """What a reader of the table must know of missing files; empty where there are none."""
        return missing_footer(self.missing.count)

    @property
    def several(self) -> bool:
        """Whether there are scenarios enough to compare over; one drive resolves nothing."""
        return any(number.precision[0].ap.scenarios > 1 for number in self.numbers)


def outcome_of(results: Sequence[MethodResult], protocol: Protocol, missing: MissingFiles = NONE_MISSING) -> Outcome:
    """The outcome of measured methods."""
    numbers = []
    for result in results:
        columns = zip(IOUS, result.intervals, result.ap)
        precision = tuple(
            Precision(iou, interval, ap.ap_global, ap.ap_legacy, ap.recall, ap.precision, ap.n_gt, ap.n_detections)
            for iou, interval, ap in columns
        )
        sent = result.communication
        numbers.append(Numbers(result.method, precision, sent, result.age_ms, result.share_ms, result.perceive_ms))
    rows = tuple(row_of(result) for result in results)
    return Outcome(protocol, tuple(numbers), rows, differences(results, protocol), _checks(rows), missing)


def show(console: Console, outcome: Outcome, title: str) -> None:
    """Table, differences and checks in the terminal."""
    console.print(terminal(outcome.rows, title))
    if outcome.footer:
        console.print(outcome.footer, highlight=False, soft_wrap=True)
    if not outcome.several:
        return
    if outcome.differences:
        console.print()
        console.print(differences_terminal(outcome.differences))
    for check in outcome.checks:
        console.print(check, highlight=False, soft_wrap=True)


def _checks(rows: Sequence[Row]) -> tuple[str, ...]:
    """Whether messages are small enough, and whether the drives are neither too easy nor too hard to tell methods apart."""
    by_name = {row.method: row for row in rows}
    out = []
    fused, alone = by_name.get("intermediate"), by_name.get("alone")
    if fused and fused.bytes_per_message is not None:
        verdict = "reached" if fused.bytes_per_message <= LARGEST_MESSAGE else "missed"
        out.append(
            f"intermediate: {fused.bytes_per_message:,.0f} bytes a message, at most {LARGEST_MESSAGE:,}: {verdict}"
        )
    if alone and alone.ap50 is not None:
        low, high = ALONE_BETWEEN
        verdict = "reached" if low <= alone.ap50.value <= high else "missed"
        out.append(f"alone: AP@0.5 {alone.ap50.value:.3f} between {low:.2f} and {high:.2f}: {verdict}")
    return tuple(out)
