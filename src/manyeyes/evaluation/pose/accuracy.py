# SPDX-License-Identifier: Apache-2.0
"""Correctors of poses on a recording: what agents detect at each instant, answers under each error of claims, their numbers.

Detections are made once and serve every corrector and every error. What is judged is defined in evaluation/pose/metrics.py. Nothing
of the truth reaches a corrector: it is kept beside the landmarks, for the claims' errors and for judging.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes._io import atomic_write
from manyeyes.agents.descriptors import seen_points
from manyeyes.agents.perception_cache import Eyes
from manyeyes.comms import wire
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import AgentFrame, Boxes, Message, Snapshot, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.evaluation.pose.metrics import (
    BUCKETS,
    ClaimNoise,
    PoseFrame,
    PoseScore,
    confusion,
    judged,
    risk_coverage,
    score,
)
from manyeyes.models.detector.detector import Detector
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import corrector
from manyeyes.pose.types import PoseStatus, planar

Floats = NDArray[np.float64]

FEW = 1
"""With so few objects in common there is nothing to match."""


@dataclass(frozen=True)
class Meeting:
    """An ego and one other agent at one instant. truth: ego_from_other; common_xy: (K, 2) true places, in the ego's frame,
    of the objects that both list. bytes: of the other's landmarks as a message on the wire.
    """

    scenario: str
    index: int
    agent: int
    ego: Landmarks
    other: Landmarks
    truth: Transform
    common_xy: Floats
    bytes: int


@dataclass(frozen=True)
class Trial:
    """A corrector and an error of claims."""

    corrector: str
    noise: ClaimNoise


@dataclass(frozen=True)
class Answered:
    """What a trial gave, meeting by meeting. expected: the status that the claim's error calls for; ms: processor time;
    bytes: of the other's landmarks on the wire.
    """

    frames: tuple[PoseFrame, ...]
    expected: tuple[PoseStatus, ...]
    ms: tuple[float, ...]
    bytes: tuple[int, ...]


@dataclass(frozen=True)
class AccuracyRow:
    """A trial's numbers, over all meetings (common None) or those with so many objects in common, first to last.

    bytes: a message of landmarks, mean. risk: share not right among the most confident twentieth, two twentieths, ... of all.
    """

    trial: Trial
    common: tuple[int, int] | None
    score: PoseScore
    bytes: float
    mean_ms: float
    p95_ms: float
    risk: tuple[float, ...]
    confusion: tuple[tuple[int, ...], ...]


def meetings(
    recording: Recording, detector: Detector, score_min: float = 0.3, every: int = 1, net: FeakmNet | None = None
) -> Iterator[Meeting]:
    """The first agent and each other, at every so many-th judged instant of every scenario.

    Landmarks are boxes of at least score_min; net: who describes them, for correctors that go by their looks.
    """
    for scenario in recording.scenarios:
        eyes: dict[int, Eyes] = {}
        for index in recording.judged(scenario)[::every]:
            # A detector of two sweeps sees the one before as well.
            for frame in recording.snapshot(scenario, index - 1).frames if index else ():
                eyes.setdefault(frame.agent_id, Eyes(detector)).see(frame)
            snapshot = recording.snapshot(scenario, index)
            told = [_told(eyes.setdefault(f.agent_id, Eyes(detector)), f, net) for f in snapshot.frames]
            yield from _met(snapshot, [t[t.boxes.score >= score_min] for t in told], net is not None)


def _told(eyes: Eyes, frame: AgentFrame, net: FeakmNet | None) -> Keypoints:
    if net is not None:
        return seen_points(net, eyes, frame)
    boxes = eyes.see(frame).boxes
    return Keypoints(boxes, torch.zeros(len(boxes), 0))


def _seen_from(frame: AgentFrame, boxes: Boxes) -> Landmarks:
    marks = Landmarks.of_boxes(boxes)
    return marks if frame.is_infrastructure else marks.with_body()


def _met(snapshot: Snapshot, told: Sequence[Keypoints], described: bool) -> Iterator[Meeting]:
    truth = snapshot.truth
    if truth is None:
        return
    marks = [
        Landmarks.of_keypoints(points) if described else _seen_from(frame, points.boxes)
        for frame, points in zip(snapshot.frames, told)
    ]
    ego_from_world = truth.world_from_agent[0].inverse()
    for row in range(1, len(snapshot.frames)):
        both = truth.boxes.center[truth.seen[0] & truth.seen[row]].double()
        frame = snapshot.frames[row]
        header = frame.agent_id, frame.timestamp_ns, frame.world_from_agent, frame.pose_covariance
        looks = told[row].descriptor if described else None
        message = Message(*header, objects=told[row].boxes, descriptors=looks)
        yield Meeting(
            snapshot.scenario,
            snapshot.index,
            frame.agent_id,
            marks[0],
            marks[row],
            ego_from_world @ truth.world_from_agent[row],
            ego_from_world.apply(both)[:, :2].numpy(),
            sum(map(len, wire.encode(message))),
        )


def common_objects(snapshot: Snapshot, reach_m: float) -> int:
    """The fewest true objects that the first agent shares with any other within reach; 0 where there is none, or no truth."""
    truth = snapshot.truth
    if truth is None:
        return 0
    place = truth.world_from_agent.translation
    near = [n for n in range(1, len(snapshot.frames)) if float((place[n] - place[0])[:2].norm()) <= reach_m]
    return min((int((truth.seen[0] & truth.seen[n]).sum()) for n in near), default=0)


def answered(met: Iterable[Meeting], trial: Trial) -> Answered:
    """A corrector's answers under an error of claims."""
    correct = corrector(trial.corrector)
    frames, expected, spent, sizes = [], [], [], []
    for meeting in met:
        truth = planar(meeting.truth)
        claimed = trial.noise.claim(truth, f"{meeting.scenario}/{meeting.agent}", meeting.index)
        begin = time.process_time()
        said = correct(meeting.ego, meeting.other, claimed)
        spent.append(1e3 * (time.process_time() - begin))
        frames.append(judged(said, truth, meeting.common_xy))
        expected.append(wanted(trial.noise.kind, len(meeting.common_xy)))
        sizes.append(meeting.bytes)
    return Answered(tuple(frames), tuple(expected), tuple(spent), tuple(sizes))


def wanted(kind: str, common: int) -> PoseStatus:
    """The status that an ideal corrector gives: of a claim so wrong, with so many objects in common."""
    if common <= FEW:
        return PoseStatus.NO_MATCH
    if kind == "offset":
        return PoseStatus.CONFLICT
    return PoseStatus.CORRECTED if kind in ("none", "unknown") else PoseStatus.OK


def rows(trial: Trial, found: Answered) -> list[AccuracyRow]:
    """The numbers over all meetings, then by common objects."""
    out = []
    for bucket in (None, *BUCKETS):
        keep = [n for n, f in enumerate(found.frames) if bucket is None or bucket[0] <= f.common <= bucket[1]]
        if not keep:
            continue
        frames, spent = [found.frames[n] for n in keep], [found.ms[n] for n in keep]
        risk = risk_coverage(frames)[1]
        twentieths = [risk[max(math.ceil(len(frames) * k / 20) - 1, 0)] for k in range(1, 21)]
        table = confusion([(found.expected[n], found.frames[n].status) for n in keep])
        out.append(
            AccuracyRow(
                trial,
                bucket,
                score(frames),
                float(np.mean([found.bytes[n] for n in keep])),
                float(np.mean(spent)),
                float(np.percentile(spent, 95)),
                tuple(map(float, twentieths)),
                tuple(tuple(map(int, line)) for line in table),
            )
        )
    return out


def kept(path: Path, make: Callable[[], Answered]) -> Answered:
    """The answers in a file, or made now and kept there, whole or not at all."""
    if path.is_file():
        held = json.loads(path.read_text(encoding="utf-8"))
        frames = tuple(PoseFrame(**(f | {"status": PoseStatus(f["status"])})) for f in held["frames"])
        return Answered(frames, tuple(map(PoseStatus, held["expected"])), tuple(held["ms"]), tuple(held["bytes"]))
    found = make()
    plain = {
        "frames": [asdict(f) | {"status": f.status.value} for f in found.frames],
        "expected": [status.value for status in found.expected],
        "ms": found.ms,
        "bytes": found.bytes,
    }
    atomic_write(path, json.dumps(plain).encode())
    return found
