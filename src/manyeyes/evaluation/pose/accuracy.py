# SPDX-License-Identifier: Apache-2.0
"""Correctors of poses on a recording: what agents detect at each instant, answers under each error of claims, their numbers.

Detections are made once and serve every corrector and every error. What is evaluated: evaluation/pose/metrics.py. Nothing
of the truth reaches a corrector: it is kept beside the landmarks, for the claims' errors and for judging.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.agents.descriptors import extract_own_keypoints
from manyeyes.agents.level_frame import SnapshotLeveller
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.comms import wire
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, Boxes, Message, Snapshot, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose.metrics import (
    COMMON_OBJECT_BUCKETS,
    PoseEvaluation,
    PoseScore,
    PriorNoise,
    compute_risk_coverage,
    count_confusion,
    evaluate_pose,
    summarize_evaluations,
)
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PoseStatus, project_to_se2

Floats = NDArray[np.float64]

MAX_UNMATCHABLE_OBJECTS = 1
"""With so few objects in common there is nothing to match."""


@dataclass(frozen=True)
class LandmarkPair:
    """An ego and one other agent at one instant. ego_from_other: ego_from_other; common_xy: (K, 2) true places, in the ego's frame,
    of the objects that both list. message_bytes: of the other's landmarks as a message on the wire. world_from_ego: true.
    """

    scenario: str
    index: int
    agent_id: int
    ego: Landmarks
    other: Landmarks
    ego_from_other: Transform
    common_xy: Floats
    message_bytes: int
    world_from_ego: Transform


@dataclass(frozen=True)
class CorrectorTrial:
    """A corrector and an error of claims."""

    corrector: str
    noise: PriorNoise


@dataclass(frozen=True)
class CorrectorRun:
    """What a trial gave, meeting by meeting. expected_status: the status that the claim's error calls for; times_ms: processor
    time; message_bytes: of the other's landmarks on the wire.
    """

    evaluations: tuple[PoseEvaluation, ...]
    expected_status: tuple[PoseStatus, ...]
    times_ms: tuple[float, ...]
    message_bytes: tuple[int, ...]


@dataclass(frozen=True)
class AccuracyRow:
    """A trial's numbers, over all meetings (common None) or those with so many objects in common, first to last.

    bytes_per_message: a message of landmarks, mean. risk_by_coverage: share not right among the most confident twentieth, two
    twentieths, ... of all.
    """

    trial: CorrectorTrial
    common_range: tuple[int, int] | None
    score: PoseScore
    bytes_per_message: float
    mean_ms: float
    p95_ms: float
    risk_by_coverage: tuple[float, ...]
    confusion: tuple[tuple[int, ...], ...]


def iterate_landmark_pairs(
    recording: Recording,
    detector: BoxDetector,
    min_score: float = 0.3,
    frame_stride: int = 1,
    net: FeakmNet | None = None,
) -> Iterator[LandmarkPair]:
    """Yield the first agent and each other, at every so many-th evaluated instant of every scenario.

    Landmarks are boxes of at least min_score. net: computes their descriptors, for correctors that use them.
    """
    level = SnapshotLeveller()
    for scenario in recording.scenarios:
        caches: dict[int, PerceptionCache] = {}
        for index in recording.eval_indices(scenario)[::frame_stride]:
            # A detector of two sweeps sees the one before as well.
            for frame in level(recording.snapshot(scenario, index - 1)).frames if index else ():
                caches.setdefault(frame.agent_id, PerceptionCache(detector)).process(frame)
            snapshot = level(recording.snapshot(scenario, index))
            keypoints = [
                _detect_keypoints(caches.setdefault(f.agent_id, PerceptionCache(detector)), f, net)
                for f in snapshot.frames
            ]
            yield from _make_landmark_pairs(
                snapshot, [t[t.boxes.score >= min_score] for t in keypoints], net is not None
            )


def _detect_keypoints(cache: PerceptionCache, frame: AgentFrame, net: FeakmNet | None) -> Keypoints:
    if net is not None:
        return extract_own_keypoints(net, cache, frame)
    boxes = cache.process(frame).boxes
    return Keypoints(boxes, torch.zeros(len(boxes), 0))


def _make_landmarks(frame: AgentFrame, boxes: Boxes) -> Landmarks:
    landmarks = Landmarks.of_boxes(boxes)
    return landmarks if frame.is_infrastructure else landmarks.with_body(frame.body)


def _make_landmark_pairs(
    snapshot: Snapshot, keypoints: Sequence[Keypoints], has_descriptors: bool
) -> Iterator[LandmarkPair]:
    truth = snapshot.truth
    if truth is None:
        return
    landmarks = [
        Landmarks.of_keypoints(points) if has_descriptors else _make_landmarks(frame, points.boxes)
        for frame, points in zip(snapshot.frames, keypoints)
    ]
    truth = truth.of_classes()
    ego_from_world = truth.world_from_agent[0].inverse()
    for row in range(1, len(snapshot.frames)):
        both = truth.boxes.center[truth.seen[0] & truth.seen[row]].double()
        frame = snapshot.frames[row]
        header = frame.agent_id, frame.timestamp_ns, frame.world_from_agent, frame.pose_covariance
        descriptors = keypoints[row].descriptor if has_descriptors else None
        message = Message(*header, objects=keypoints[row].boxes, descriptors=descriptors)
        yield LandmarkPair(
            snapshot.scenario,
            snapshot.index,
            frame.agent_id,
            landmarks[0],
            landmarks[row],
            ego_from_world @ truth.world_from_agent[row],
            ego_from_world.apply(both)[:, :2].numpy(),
            sum(map(len, wire.encode(message))),
            truth.world_from_agent[0],
        )


def count_common_objects(snapshot: Snapshot, max_range_m: float) -> int:
    """Return the fewest true objects that the first agent shares with any other within reach; 0 where there is none, or no
    truth.
    """
    truth = snapshot.truth
    if truth is None:
        return 0
    truth = truth.of_classes()
    positions = truth.world_from_agent.translation
    in_range = [
        n for n in range(1, len(snapshot.frames)) if float((positions[n] - positions[0])[:2].norm()) <= max_range_m
    ]
    return min((int((truth.seen[0] & truth.seen[n]).sum()) for n in in_range), default=0)


def run_corrector(pairs: Iterable[LandmarkPair], trial: CorrectorTrial) -> CorrectorRun:
    """Return a corrector's answers under an error of claims."""
    correct = load_corrector(trial.corrector)
    evaluations, expected, times_ms, sizes = [], [], [], []
    for pair in pairs:
        truth = project_to_se2(pair.ego_from_other)
        prior = trial.noise.make_prior(truth, f"{pair.scenario}/{pair.agent_id}", pair.index)
        begin = time.process_time()
        estimate = correct(pair.ego, pair.other, prior)
        times_ms.append(1e3 * (time.process_time() - begin))
        evaluations.append(evaluate_pose(estimate, truth, pair.common_xy))
        expected.append(get_expected_status(trial.noise.kind, len(pair.common_xy)))
        sizes.append(pair.message_bytes)
    return CorrectorRun(tuple(evaluations), tuple(expected), tuple(times_ms), tuple(sizes))


def get_expected_status(kind: str, num_common: int) -> PoseStatus:
    """Return the status that an ideal corrector gives: of a claim so wrong, with so many objects in common."""
    if num_common <= MAX_UNMATCHABLE_OBJECTS:
        return PoseStatus.NO_MATCH
    if kind == "offset":
        return PoseStatus.CONFLICT
    return PoseStatus.CORRECTED if kind in ("none", "unknown") else PoseStatus.OK


def summarize_run(trial: CorrectorTrial, run: CorrectorRun) -> list[AccuracyRow]:
    """Return the numbers over all meetings, then by common objects."""
    out = []
    for bucket in (None, *COMMON_OBJECT_BUCKETS):
        keep = [n for n, f in enumerate(run.evaluations) if bucket is None or bucket[0] <= f.num_common <= bucket[1]]
        if not keep:
            continue
        evaluations, times_ms = [run.evaluations[n] for n in keep], [run.times_ms[n] for n in keep]
        risk = compute_risk_coverage(evaluations)[1]
        risk_by_coverage = [risk[max(math.ceil(len(evaluations) * k / 20) - 1, 0)] for k in range(1, 21)]
        table = count_confusion([(run.expected_status[n], run.evaluations[n].status) for n in keep])
        out.append(
            AccuracyRow(
                trial,
                bucket,
                summarize_evaluations(evaluations),
                float(np.mean([run.message_bytes[n] for n in keep])),
                float(np.mean(times_ms)),
                float(np.percentile(times_ms, 95)),
                tuple(map(float, risk_by_coverage)),
                tuple(tuple(map(int, line)) for line in table),
            )
        )
    return out
