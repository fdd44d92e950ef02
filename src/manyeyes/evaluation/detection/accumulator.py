# SPDX-License-Identifier: Apache-2.0
"""What one method did, counted step by step as a drive is played, and the numbers that follow from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from manyeyes.agents.replay import ReplayStep
from manyeyes.evaluation.detection.average_precision import (
    ApResult,
    DetectionProtocol,
    FrameIou,
    FrameMatch,
    FrameResult,
    compute_ap,
    compute_frame_iou,
    match_frame,
    select_ego_truth,
)
from manyeyes.evaluation.detection.communication import Communication, MessageRecord, summarize_messages
from manyeyes.evaluation.statistics.bootstrap import Interval, bootstrap
from manyeyes.evaluation.statistics.reliability import Reliability, compute_reliability

IOU_THRESHOLDS = (0.5, 0.7)


@dataclass(frozen=True)
class MethodResult:
    """One method over all scenarios. ap and intervals: one an IoU threshold, in the order of IOUS."""

    method: str
    ap: tuple[ApResult, ...]
    intervals: tuple[Interval, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float

    def paired_difference(self, other: MethodResult, iou: int, protocol: DetectionProtocol) -> Interval:
        """Return the AP of this method minus that of another, paired over scenarios. iou: index into IOUS."""
        samples = (bootstrap(result.ap[iou].frames, protocol=protocol) for result in (self, other))
        return next(samples).paired_difference(next(samples))


@dataclass
class MetricAccumulator:
    """What one method did so far, in the little that judging needs: no cloud is kept.

    speeds: (G,) m/s of each frame's true boxes. Messages are those that other agents sent for an ego's frame, arrived or not.
    share_s counts calls that returned a message.
    """

    method: str
    protocol: DetectionProtocol
    frames: list[FrameIou] = field(default_factory=list)
    speeds: list[Tensor] = field(default_factory=list)
    messages: list[MessageRecord] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    share_s: list[float] = field(default_factory=list)
    perceive_s: list[float] = field(default_factory=list)

    def add(self, step: ReplayStep) -> None:
        """Count one ego at one instant."""
        snapshot, ego = step.snapshot, step.snapshot.frames[step.ego].agent_id
        truth = select_ego_truth(snapshot, step.ego, self.protocol)
        result = FrameResult(snapshot.scenario, snapshot.index, step.boxes, truth)
        self.frames.append(compute_frame_iou(result, self.protocol))
        self.speeds.append(truth.velocity.norm(dim=1))
        received = (h.message for h in step.perception.received)
        arrived = {m.agent_id: tuple(m.tokens.features.shape) for m in received if m.tokens is not None}
        for sent in step.sent:
            if sent.num_packets:
                self.share_s.append(sent.seconds)
            if sent.num_packets and sent.agent_id != ego:
                cells, channels = arrived.get(sent.agent_id, (0, 0))
                record = MessageRecord(
                    snapshot.scenario, snapshot.index, sent.agent_id, sent.num_bytes, cells, channels, ego=ego
                )
                self.messages.append(record)
        self.ages_s += step.ages_s
        self.perceive_s.append(step.perceive_seconds)

    def extend(self, other: MetricAccumulator) -> None:
        """Count what another tally of this method counted."""
        self.frames += other.frames
        self.speeds += other.speeds
        self.messages += other.messages
        self.ages_s += other.ages_s
        self.share_s += other.share_s
        self.perceive_s += other.perceive_s

    def match_frames(self) -> tuple[tuple[FrameMatch, ...], ...]:
        """Return the frames matched at each of IOUS, in the order they came in."""
        return tuple(tuple(match_frame(frame, iou, self.protocol) for frame in self.frames) for iou in IOU_THRESHOLDS)

    def compute_reliability(self) -> Reliability:
        """Return the reliability of the scores of evaluated boxes, correct at the first of IOUS."""
        matches = [match_frame(frame, IOU_THRESHOLDS[0], self.protocol) for frame in self.frames]
        score = np.concatenate([match.score.numpy() for match in matches] or [np.zeros(0)])
        is_correct = np.concatenate([match.tp.numpy() for match in matches] or [np.zeros(0, dtype=bool)])
        return compute_reliability(score, is_correct)

    def summarize_communication(self) -> Communication:
        """Summarise what was sent, in bytes a message."""
        return summarize_messages(self.messages, len(self.frames))

    def mean_age_ms(self) -> float:
        """Return the mean age of what took part, when it was used; NaN where nothing did."""
        return _mean_ms(self.ages_s)

    def compute_result(self) -> MethodResult:
        """Return the numbers of everything counted so far."""
        matches = self.match_frames()
        return MethodResult(
            self.method,
            tuple(compute_ap(m, self.protocol) for m in matches),
            tuple(bootstrap(m, protocol=self.protocol).interval() for m in matches),
            self.summarize_communication(),
            self.mean_age_ms(),
            _mean_ms(self.share_s),
            _mean_ms(self.perceive_s),
        )


def _mean_ms(seconds: Sequence[float]) -> float:
    return 1000 * sum(seconds) / len(seconds) if seconds else math.nan
