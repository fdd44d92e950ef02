# SPDX-License-Identifier: Apache-2.0
"""Answers about a few hand-made meetings: what is expected, counted and kept."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.evaluation.pose.accuracy import (
    CorrectorTrial,
    LandmarkPair,
    count_common_objects,
    get_expected_status,
    run_corrector,
    summarize_run,
)
from manyeyes.evaluation.pose.metrics import PriorNoise
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseStatus

EGO_FROM_OTHER = Transform.from_xyz_yaw(12.0, -3.0, 0.0, 2.0)


def make_landmarks(count: int, seed: int) -> Landmarks:
    rng = np.random.default_rng(seed)
    center = torch.from_numpy(np.column_stack((rng.uniform(-30, 30, (count, 2)), np.ones(count))))
    size = torch.tensor([[4.5, 1.9, 1.6]]).double().repeat(count, 1)
    return Landmarks.of_boxes(Boxes.of(center, size, torch.from_numpy(rng.uniform(-3, 3, count))))


def make_pair(common: int, index: int) -> LandmarkPair:
    ego = make_landmarks(10, index)
    back = EGO_FROM_OTHER.inverse()
    there = np.array([*back.translation[:2].tolist(), float(back.yaw)])
    other = ego.transform(there) if common else make_landmarks(10, index + 50)
    return LandmarkPair(
        "drive", index, 7, ego, other, EGO_FROM_OTHER, ego.xy[:common], 150 + index, Transform.identity()
    )


def test_evaluations_follow_priors_and_objects() -> None:
    pairs = [make_pair(9, 0), make_pair(0, 1)]
    found = run_corrector(pairs, CorrectorTrial("voting", PriorNoise("offset", 0.5, 0.5)))
    assert [f.status for f in found.evaluations] == [PoseStatus.CONFLICT, PoseStatus.NO_MATCH]
    assert found.expected_status == (PoseStatus.CONFLICT, PoseStatus.NO_MATCH) and found.message_bytes == (150, 151)
    assert found.evaluations[0].translation_error_m < 0.1 and found.evaluations[1].translation_error_m == pytest.approx(
        2.5
    )
    whole, none, many = summarize_run(CorrectorTrial("voting", PriorNoise("offset", 0.5, 0.5)), found)
    assert (whole.common_range, none.common_range, many.common_range) == (None, (0, 0), (8, 10**9))
    assert whole.score.conflict_rate == 0.5 and many.score.conflict_rate == 1.0 and whole.bytes_per_message == 150.5
    assert whole.confusion[2][2] == 1 and whole.confusion[4][4] == 1 and sum(map(sum, whole.confusion)) == 2
    assert whole.risk_by_coverage[0] == 0.0 and whole.risk_by_coverage[-1] == 0.5


@pytest.mark.parametrize(
    "kind, common, status",
    [
        ("gaussian", 5, "OK"),
        ("none", 5, "CORRECTED"),
        ("unknown", 2, "CORRECTED"),
        ("offset", 9, "CONFLICT"),
        ("bias", 1, "NO_MATCH"),
    ],
)
def test_expected_status_of_an_ideal_corrector(kind: str, common: int, status: str) -> None:
    assert get_expected_status(kind, common) is PoseStatus[status]


def test_common_objects_are_the_minimum_over_agents_in_range() -> None:
    poses = [Transform.from_xyz_yaw(x, 0.0) for x in (0.0, 20.0, 50.0, 300.0)]
    frames = tuple(AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), p, agent_id=n) for n, p in enumerate(poses))
    boxes = Boxes.of(torch.zeros(3, 3).double(), torch.ones(3, 3).double(), torch.zeros(3).double())
    seen = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 1, 1], [0, 0, 0]]).bool()
    snapshot = Snapshot("drive", 0, frames, GroundTruth(boxes, seen, Transform.stack(poses)))
    assert count_common_objects(snapshot, 70.0) == 2
    assert count_common_objects(snapshot, 500.0) == 0 and count_common_objects(snapshot, 10.0) == 0
    assert count_common_objects(Snapshot("drive", 0, frames), 70.0) == 0
