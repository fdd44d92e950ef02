# SPDX-License-Identifier: Apache-2.0
"""Answers about a few hand-made meetings: what is expected, counted and kept."""

import math

import numpy as np
import pytest
import torch

from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, Snapshot, Transform, Truth
from manyeyes.evaluation.pose.accuracy import Answered, Meeting, Trial, answered, common_objects, kept, rows, wanted
from manyeyes.evaluation.pose.metrics import ClaimNoise, PoseFrame
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PoseStatus

EGO_FROM_OTHER = Transform.from_xyz_yaw(12.0, -3.0, 0.0, 2.0)


def marks(count: int, seed: int) -> Landmarks:
    rng = np.random.default_rng(seed)
    center = torch.from_numpy(np.column_stack((rng.uniform(-30, 30, (count, 2)), np.ones(count))))
    size = torch.tensor([[4.5, 1.9, 1.6]]).double().repeat(count, 1)
    return Landmarks.of_boxes(Boxes.of(center, size, torch.from_numpy(rng.uniform(-3, 3, count))))


def meeting(common: int, index: int) -> Meeting:
    ego = marks(10, index)
    back = EGO_FROM_OTHER.inverse()
    there = np.array([*back.translation[:2].tolist(), float(back.yaw)])
    other = ego.moved(there) if common else marks(10, index + 50)
    return Meeting("drive", index, 7, ego, other, EGO_FROM_OTHER, ego.xy[:common], 150 + index)


def test_answers_follow_claims_and_objects() -> None:
    met = [meeting(9, 0), meeting(0, 1)]
    found = answered(met, Trial("vote", ClaimNoise("offset", 0.5, 0.5)))
    assert [f.status for f in found.frames] == [PoseStatus.CONFLICT, PoseStatus.NO_MATCH]
    assert found.expected == (PoseStatus.CONFLICT, PoseStatus.NO_MATCH) and found.bytes == (150, 151)
    assert found.frames[0].metres < 0.1 and found.frames[1].metres == pytest.approx(2.5)
    whole, none, many = rows(Trial("vote", ClaimNoise("offset", 0.5, 0.5)), found)
    assert (whole.common, none.common, many.common) == (None, (0, 0), (8, 10**9))
    assert whole.score.conflicts == 0.5 and many.score.conflicts == 1.0 and whole.bytes == 150.5
    assert whole.confusion[2][2] == 1 and whole.confusion[4][4] == 1 and sum(map(sum, whole.confusion)) == 2
    assert whole.risk[0] == 0.0 and whole.risk[-1] == 0.5


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
def test_what_an_ideal_corrector_says(kind: str, common: int, status: str) -> None:
    assert wanted(kind, common) is PoseStatus[status]


def test_answers_are_kept_as_they_were_and_not_made_again(tmp_path) -> None:
    nothing = PoseFrame(PoseStatus.NO_MATCH, 0, math.inf, math.inf, math.nan, math.nan, -math.inf)
    made = Answered((nothing,), (PoseStatus.OK,), (1.5,), (99,))
    path = tmp_path / "cells" / "pose.json"
    assert kept(path, lambda: made) is made
    again = kept(path, lambda: pytest.fail("made again"))
    assert again.expected == made.expected and again.ms == made.ms and again.bytes == made.bytes
    assert again.frames[0].metres == math.inf and math.isnan(again.frames[0].nees)


def test_common_objects_are_the_fewest_with_anybody_in_reach() -> None:
    poses = [Transform.from_xyz_yaw(x, 0.0) for x in (0.0, 20.0, 50.0, 300.0)]
    frames = tuple(AgentFrame.of(PointCloud.of(torch.zeros(0, 3)), p, agent_id=n) for n, p in enumerate(poses))
    boxes = Boxes.of(torch.zeros(3, 3).double(), torch.ones(3, 3).double(), torch.zeros(3).double())
    seen = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 1, 1], [0, 0, 0]]).bool()
    snapshot = Snapshot("drive", 0, frames, Truth(boxes, seen, Transform.stack(poses)))
    assert common_objects(snapshot, 70.0) == 2
    assert common_objects(snapshot, 500.0) == 0 and common_objects(snapshot, 10.0) == 0
    assert common_objects(Snapshot("drive", 0, frames), 70.0) == 0
