# SPDX-License-Identifier: Apache-2.0
"""Functions on any recording."""

from __future__ import annotations

import pytest
import torch

from manyeyes.datasets.base import Recording, count_points_in_listed_boxes, iter_eval_frames, require_index
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, RecordingError, Snapshot, Transform


class InMemory:
    """Two scenarios of three and two empty snapshots, the first of each for history only."""

    scenarios = ("a", "b")

    def length(self, scenario: str) -> int:
        return {"a": 3, "b": 2}[scenario]

    def eval_indices(self, scenario: str) -> range:
        return range(1, self.length(scenario))

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (0,)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        require_index(self, scenario, index)
        return Snapshot(scenario, index, ())


def test_evaluated_frames_are_ordered_by_scenario() -> None:
    recording: Recording = InMemory()
    assert list(iter_eval_frames(recording)) == [("a", 1), ("a", 2), ("b", 1)]


@pytest.mark.parametrize(
    ("scenario", "index", "message_match"),
    [("c", 0, "No scenario 'c'.*a, b"), ("b", 2, "index from 0 to 1"), ("a", -1, "index from 0 to 2")],
)
def test_missing_scenarios_are_rejected(scenario: str, index: int, message_match: str) -> None:
    with pytest.raises(RecordingError, match=message_match):
        InMemory().snapshot(scenario, index)


def test_points_in_listed_boxes_by_hand() -> None:
    # An agent at (100, 0) that looks along +y; a 4 x 2 x 2 box 10 m ahead of it, lengthways; one 5 m to its left, unlisted.
    world_from_agent = Transform.from_xyz_yaw(100.0, 0.0, 0.0, torch.pi / 2)
    points = torch.tensor([[8.05, 0, 1.0], [11.9, 0.9, 0.1], [12.05, 0, 1], [12.2, 0, 1], [10, 1.2, 1], [0, 5, 1]])
    boxes = Boxes.of(
        torch.tensor([[100.0, 10, 1], [95, 0, 1]]).double(),
        torch.tensor([[4.0, 2, 2], [4, 2, 2]]).double(),
        torch.full((2,), torch.pi / 2).double(),
        id=torch.tensor([7, 8]),
    )
    frame = AgentFrame.of(PointCloud.of(points), world_from_agent)
    seen = torch.tensor([[True, False], [True, True]])
    truth = GroundTruth(boxes, seen, Transform.stack([world_from_agent, Transform.identity()]))
    snapshot = Snapshot("a", 0, (frame, AgentFrame.of(PointCloud.of(points), Transform.identity())), truth)
    assert count_points_in_listed_boxes(snapshot, 0.0).tolist() == [[2, -1], [0, 0]]
    assert count_points_in_listed_boxes(snapshot, 0.1).tolist() == [[3, -1], [0, 0]]
    with pytest.raises(RecordingError, match="has no truth"):
        count_points_in_listed_boxes(Snapshot("a", 0, (frame,)))
