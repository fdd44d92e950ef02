# SPDX-License-Identifier: Apache-2.0
"""Methods side by side: counted step by step as a drive is played, and held against the bars that they are to clear.

A bar is judged on the paired difference over scenarios: "reached" when the whole 95 % interval is at or above it, "missed"
when it is below, else "not resolved". One scenario alone resolves nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from manyeyes.agents.replay import Step
from manyeyes.evaluation.benchmark import IOUS, MethodResult
from manyeyes.evaluation.bootstrap import Interval, Verdict, resolved, scenario_interval
from manyeyes.evaluation.communication import MessageRecord, summarise
from manyeyes.evaluation.detection import (
    FrameOverlap,
    FrameResult,
    Protocol,
    ap_of_matches,
    ego_truth,
    match_frame,
    overlap_frame,
)


@dataclass
class Tally:
    """What one method did so far, in the little that judging needs: no cloud is kept.

    Messages are those that other agents sent for an ego's frame, arrived or not. share_s counts calls that said something.
    """

    method: str
    protocol: Protocol
    frames: list[FrameOverlap] = field(default_factory=list)
    messages: list[MessageRecord] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    share_s: list[float] = field(default_factory=list)
    perceive_s: list[float] = field(default_factory=list)

    def add(self, step: Step) -> None:
        """Count one ego at one instant."""
        snapshot, ego = step.snapshot, step.snapshot.frames[step.ego].agent_id
        truth = ego_truth(snapshot, step.ego, self.protocol)
        result = FrameResult(snapshot.scenario, snapshot.index, step.boxes, truth)
        self.frames.append(overlap_frame(result, self.protocol))
        for sent in step.sent:
            if sent.packets:
                self.share_s.append(sent.seconds)
            if sent.packets and sent.agent_id != ego:
                record = MessageRecord(snapshot.scenario, snapshot.index, sent.agent_id, sent.bytes, ego=ego)
                self.messages.append(record)
        self.ages_s += step.ages_s
        self.perceive_s.append(step.perceive_seconds)

    def result(self) -> MethodResult:
        """The numbers of everything counted so far."""
        matches = [[match_frame(frame, iou, self.protocol) for frame in self.frames] for iou in IOUS]
        return MethodResult(
            self.method,
            tuple(ap_of_matches(m, self.protocol) for m in matches),
            tuple(scenario_interval(m, protocol=self.protocol) for m in matches),
            summarise(self.messages, len(self.frames)),
            _mean_ms(self.ages_s),
            _mean_ms(self.share_s),
            _mean_ms(self.perceive_s),
        )


@dataclass(frozen=True)
class Bar:
    """What a method is to be better than a rival by, in AP at an IoU threshold."""

    method: str
    rival: str
    at_least: float
    iou: float = 0.5


BARS = (Bar("intermediate", "alone", 0.12), Bar("intermediate", "late", 0.02))


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


def _mean_ms(seconds: Sequence[float]) -> float:
    return 1000 * sum(seconds) / len(seconds) if seconds else math.nan
