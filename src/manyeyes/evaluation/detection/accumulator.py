# SPDX-License-Identifier: Apache-2.0
"""What one method did, counted step by step as a drive is played, and the numbers that follow from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from torch import Tensor

from manyeyes.agents.replay import ReplayStep
from manyeyes.datatypes import VEHICLES
from manyeyes.evaluation.detection.answer_time import Answer
from manyeyes.evaluation.detection.average_precision import (
    ApResult,
    compute_ap,
    compute_frame_ious,
    match_frame,
    select_ego_truth,
)
from manyeyes.evaluation.detection.communication import Communication, MessageRecord, summarize_messages
from manyeyes.evaluation.detection.frame_match import FrameIou, FrameMatch, FrameResult
from manyeyes.evaluation.detection.protocols import DetectionProtocol
from manyeyes.evaluation.statistics.bootstrap import Interval, bootstrap
from manyeyes.evaluation.statistics.operating_point import (
    OperatingPoint,
    OperatingThreshold,
    compute_operating_point,
    find_best_threshold,
)
from manyeyes.evaluation.statistics.reliability import Reliability, compute_reliability
from manyeyes.models.score_calibration import DEFAULT_DRAWING_SCORE

IOU_THRESHOLDS = (0.5, 0.7)
DEFAULT_THRESHOLD = OperatingThreshold(DEFAULT_DRAWING_SCORE, "default")


@dataclass(frozen=True)
class MethodResult:
    """One method over all scenarios, its metrics of one class.

    ap, intervals and legacy_intervals (of the AP over concatenated frames): one an IoU threshold, in the order of IOU_THRESHOLDS.
    operating_point: at the first of them. best_threshold: the score of greatest F there, for an evaluation of other data.
    answer_ap, answer_intervals: the same at the time of the answer, and answer_ms the mean time from sweep to answer; empty and NaN
    where that was not judged.
    resamples: AP on each resample of the scenarios, for each IoU threshold.
    """

    method: str
    ap: tuple[ApResult, ...]
    intervals: tuple[Interval, ...]
    communication: Communication
    age_ms: float
    share_ms: float
    perceive_ms: float
    class_name: str = VEHICLES[0]
    legacy_intervals: tuple[Interval, ...] = ()
    operating_point: OperatingPoint | None = None
    best_threshold: float | None = None
    answer_ap: tuple[ApResult, ...] = ()
    answer_intervals: tuple[Interval, ...] = ()
    answer_ms: float = math.nan
    resamples: tuple[tuple[float, ...], ...] = ()

    def paired_difference(self, other: MethodResult, iou: int, protocol: DetectionProtocol) -> Interval:
        """Return the AP of this method minus that of another, paired over scenarios. iou: index into IOU_THRESHOLDS."""
        samples = (bootstrap(result.ap[iou].frames, protocol=protocol) for result in (self, other))
        return next(samples).paired_difference(next(samples))


@dataclass
class MetricAccumulator:
    """What one method did so far, in the little that judging needs: no cloud is kept.

    frames: of each class of the protocol, step by step. speeds: (G,) m/s of each frame's true boxes. Messages are those that other
    agents sent for an ego's frame, arrived or not. share_s counts calls that returned a message.
    """

    method: str
    protocol: DetectionProtocol
    frames: list[FrameIou] = field(default_factory=list)
    speeds: list[Tensor] = field(default_factory=list)
    messages: list[MessageRecord] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    share_s: list[float] = field(default_factory=list)
    perceive_s: list[float] = field(default_factory=list)
    answer_frames: list[FrameIou] = field(default_factory=list)
    answer_s: list[float] = field(default_factory=list)

    def add(self, step: ReplayStep, answer: Answer | None = None) -> None:
        """Count one ego at one instant; answer: what it is at the time of the answer, if that is judged too."""
        snapshot, ego = step.snapshot, step.snapshot.frames[step.ego].agent_id
        truth = select_ego_truth(snapshot, step.ego, self.protocol)
        result = FrameResult(snapshot.scenario, snapshot.index, step.boxes, truth)
        self.frames += compute_frame_ious(result, self.protocol)
        self.speeds += [truth.of_classes((name,)).velocity.norm(dim=1) for name in self.protocol.classes]
        received = (h.message for h in step.perception.received)
        channels = max((m.tokens.features.shape[1] for m in received if m.tokens is not None), default=0)
        for sent in step.sent:
            if sent.num_packets:
                self.share_s.append(sent.seconds)
            if sent.num_packets and sent.agent_id != ego:
                held = sent.contents
                counts = (held.num_tokens, channels, held.num_objects, held.num_points)
                record = MessageRecord(
                    snapshot.scenario, snapshot.index, sent.agent_id, sent.num_bytes, *counts, ego=ego
                )
                self.messages.append(record)
        self.ages_s += step.ages_s
        self.perceive_s.append(step.perceive_seconds)
        if answer is not None:
            truth = select_ego_truth(answer.snapshot, answer.ego, self.protocol)
            moved = FrameResult(snapshot.scenario, snapshot.index, answer.boxes, truth)
            self.answer_frames += compute_frame_ious(moved, self.protocol)
            self.answer_s.append(answer.seconds)

    def extend(self, other: MetricAccumulator) -> None:
        """Count what another tally of this method counted."""
        self.frames += other.frames
        self.speeds += other.speeds
        self.messages += other.messages
        self.ages_s += other.ages_s
        self.share_s += other.share_s
        self.perceive_s += other.perceive_s
        self.answer_frames += other.answer_frames
        self.answer_s += other.answer_s

    def match_frames(self) -> tuple[tuple[FrameMatch, ...], ...]:
        """Return the frames, of all classes, matched at each of IOU_THRESHOLDS, in the order they came in."""
        return self._match(self.frames)

    def match_answers(self) -> tuple[tuple[FrameMatch, ...], ...]:
        """Return the same at the time of the answer; nothing where that was not judged."""
        return self._match(self.answer_frames) if self.answer_frames else ()

    def _match(self, frames: Sequence[FrameIou]) -> tuple[tuple[FrameMatch, ...], ...]:
        return tuple(
            tuple(match_frame(frame, iou, self._protocol_of(frame.class_name)) for frame in frames)
            for iou in IOU_THRESHOLDS
        )

    def mean_answer_ms(self) -> float:
        """Return the mean time from sweep to answer; NaN where that was not judged."""
        return _mean_ms(self.answer_s)

    def _protocol_of(self, class_name: str) -> DetectionProtocol:
        return self.protocol.with_classes((class_name,))

    def compute_reliability(self, class_name: str | None = None) -> Reliability:
        """Return the reliability of the scores of evaluated boxes of a class, by default the first of the protocol, correct at the
        first of IOU_THRESHOLDS.
        """
        protocol = self._protocol_of(class_name or self.protocol.classes[0])
        frames = (frame for frame in self.frames if frame.class_name == protocol.class_name)
        matches = [match_frame(frame, IOU_THRESHOLDS[0], protocol) for frame in frames]
        score = np.concatenate([match.score.numpy() for match in matches] or [np.zeros(0)])
        is_correct = np.concatenate([match.tp.numpy() for match in matches] or [np.zeros(0, dtype=bool)])
        return compute_reliability(score, is_correct)

    def summarize_communication(self) -> Communication:
        """Summarise what was sent, in bytes a message."""
        return summarize_messages(self.messages, len(self.frames) // len(self.protocol.classes))

    def mean_age_ms(self) -> float:
        """Return the mean age of what took part, when it was used; NaN where nothing did."""
        return _mean_ms(self.ages_s)

    def compute_results(self, thresholds: Mapping[str, OperatingThreshold] | None = None) -> tuple[MethodResult, ...]:
        """Return the numbers of everything counted so far, of each class of the protocol.

        thresholds: by class; DEFAULT_THRESHOLD of those that it lacks.
        """
        matched, answers = self.match_frames(), self.match_answers()
        return tuple(
            self._compute_class(name, matched, answers, (thresholds or {}).get(name, DEFAULT_THRESHOLD))
            for name in self.protocol.classes
        )

    def _compute_class(
        self,
        name: str,
        matched: Sequence[Sequence[FrameMatch]],
        answers: Sequence[Sequence[FrameMatch]],
        threshold: OperatingThreshold,
    ) -> MethodResult:
        protocol = self._protocol_of(name)
        legacy = replace(protocol, ap_order="concatenated")
        matches, moved = (
            [[match for match in column if match.class_name == name] for column in columns]
            for columns in (matched, answers)
        )
        samples = [bootstrap(m, protocol=protocol) for m in matches]
        return MethodResult(
            self.method,
            tuple(compute_ap(m, protocol) for m in matches),
            tuple(s.interval() for s in samples),
            self.summarize_communication(),
            self.mean_age_ms(),
            _mean_ms(self.share_s),
            _mean_ms(self.perceive_s),
            name,
            tuple(bootstrap(m, protocol=legacy).interval() for m in matches),
            compute_operating_point(matches[0], threshold, protocol),
            find_best_threshold(matches[0], protocol),
            tuple(compute_ap(m, protocol) for m in moved),
            tuple(bootstrap(m, protocol=protocol).interval() for m in moved),
            self.mean_answer_ms(),
            tuple(tuple(s.samples.tolist()) for s in samples),
        )


def _mean_ms(seconds: Sequence[float]) -> float:
    return 1000 * sum(seconds) / len(seconds) if seconds else math.nan
