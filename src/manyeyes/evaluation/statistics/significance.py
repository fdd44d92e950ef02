# SPDX-License-Identifier: Apache-2.0
"""Claims of a study: a paired difference between two of its cells, held against a bar where one is set."""

from __future__ import annotations

from dataclasses import dataclass

from manyeyes.evaluation.detection.accumulator import IOUS
from manyeyes.evaluation.statistics.bootstrap import Interval, Verdict, resolved
from manyeyes.evaluation.study import Place, Sweep


@dataclass(frozen=True)
class Claim:
    """AP of one cell minus that of another; the verdict says whether the whole interval is at or above the bar."""

    what: str
    iou: float
    difference: Interval
    bar: float
    verdict: Verdict


def claim(what: str, sweep: Sweep, place: Place, other: Place, iou: int, bar: float) -> Claim:
    """The claim that a cell's AP minus another's is at least the bar. iou counts the thresholds of IOUS."""
    difference = sweep.less(place, other, iou)
    several = difference.scenarios > 1
    verdict = resolved(bar, difference.low, difference.high) if several else "not resolved"
    return Claim(what, IOUS[iou], difference, bar, verdict)
