# SPDX-License-Identifier: Apache-2.0
"""Methods side by side, held against the bars that they are to clear.

A bar is judged on the paired difference over scenarios: "reached" when the whole 95 % interval is at or above it, "missed"
when it is below, else "not resolved". One scenario alone resolves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOUS, MethodResult
from manyeyes.evaluation.detection.average_precision import Protocol
from manyeyes.evaluation.statistics.bootstrap import Interval, Verdict, resolved


@dataclass(frozen=True)
class Bar:
    """What a method is to be better than a rival by, in AP at an IoU threshold."""

    method: str
    rival: str
    at_least: float
    iou: float = 0.5


BARS = (
    Bar("intermediate", "alone", 0.12),
    Bar("intermediate", "late", 0.02),
    Bar("intermediate", "late-remembering", 0.02),
)


@dataclass(frozen=True)
class Difference:
    """AP of a method less that of a rival, on the same resampled scenarios; bar and verdict are None where none is set."""

    method: str
    rival: str
    iou: float
    interval: Interval
    bar: float | None
    verdict: Verdict | None


def differences(
    results: Sequence[MethodResult], protocol: Protocol, method: str = "intermediate", bars: Sequence[Bar] = BARS
) -> tuple[Difference, ...]:
    """One method against every other, at every IoU threshold; nothing where the method was not run."""
    known = {(bar.method, bar.rival, bar.iou): bar.at_least for bar in bars}
    by_name = {result.method: result for result in results}
    if method not in by_name:
        return ()
    out = []
    for rival in (r for r in results if r.method != method):
        for column, iou in enumerate(IOUS):
            interval = by_name[method].less(rival, column, protocol)
            bar = known.get((method, rival.method, iou))
            out.append(Difference(method, rival.method, iou, interval, bar, _verdict(bar, interval)))
    return tuple(out)


def _verdict(bar: float | None, interval: Interval) -> Verdict | None:
    if bar is None:
        return None
    return resolved(bar, interval.low, interval.high) if interval.scenarios > 1 else "not resolved"
