# SPDX-License-Identifier: Apache-2.0
"""The agent's own vehicle: no returns from it, not among its results, and sent with every message."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.own_detections import remove_own_body
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import AgentBody, AgentFrame, BevGrid, Boxes, PointCloud, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.protocols import BoxDetector

REAR_AXLE = AgentBody.standing(1.4, 0.0, (4.9, 2.0, 1.6))


class Recorder(BoxDetector):
    """Records its clouds; one box at each point above 1 m."""

    grid = BevGrid(-60.0, -60.0, -3.0, 60.0, 60.0, 3.0)

    def __init__(self) -> None:
        self.clouds: list[PointCloud] = []

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        self.clouds.append(points)
        high = points.xyz[points.xyz[:, 2] > 1.0]
        return Boxes.of(high, torch.tensor([[4.5, 1.9, 1.6]]).expand(len(high), 3), torch.zeros(len(high)))


def frame_of(*points: tuple[float, float, float], body: AgentBody | None = REAR_AXLE, agent_id: int = 0) -> AgentFrame:
    return AgentFrame.of(torch.tensor(points), Transform.from_xyz_yaw(5.0, 0.0), agent_id, body=body)


@pytest.mark.parametrize("body, count", [(REAR_AXLE, 2), (None, 4)])
@pytest.mark.parametrize("name", ["no-fusion", "late", "early"])
def test_returns_from_the_own_vehicle_are_not_perceived(name: str, body: AgentBody | None, count: int) -> None:
    frame = frame_of((3.6, 0.5, 1.2), (0.0, 0.9, 0.9), (20.0, 1.0, 1.3), (-3.0, 0.0, 1.2), body=body)
    detector = Recorder()
    agent = Agent(detector, get_strategy(name))
    packets = agent.share(frame)
    agent.perceive(frame)
    assert {len(cloud) for cloud in detector.clouds} == {count}
    assert not packets or len(frame.points) == 4


def test_the_own_box_is_removed_where_the_body_is() -> None:
    center = torch.tensor([[1.4, 0.0, 0.8], [3.9, 0.2, 0.8], [4.5, 0.0, 0.8], [-2.0, 0.0, 0.8], [-1.0, 1.2, 0.8]])
    boxes = Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).expand(5, 3), torch.zeros(5))
    kept = {
        name: remove_own_body(boxes, replace(frame_of((0.0, 0.0, 9.0)), **change)).center[:, 0].tolist()
        for name, change in {
            "known": {},
            "unknown": {"body": None},
            "infrastructure": {"is_infrastructure": True, "body": None},
        }.items()
    }
    assert kept["known"] == pytest.approx([4.5, -2.0])
    # The area around the origin, as before bodies were known.
    assert kept["unknown"] == pytest.approx([3.9, 4.5])
    assert len(kept["infrastructure"]) == 5


@pytest.mark.parametrize("name", ["late", "early"])
def test_messages_carry_the_body(name: str) -> None:
    sender, ego = (Agent(Recorder(), get_strategy(name)) for _ in range(2))
    packets = sender.share(frame_of((10.0, 0.0, 1.5), agent_id=3))
    (received,) = ego.perceive(frame_of((9.0, 0.0, 1.4)), packets).received
    assert received.message.body == REAR_AXLE


def test_a_budget_of_tokens_counts_the_body(drive, detector: Detector) -> None:
    frame = replace(drive().frame(1, 3), body=REAR_AXLE)
    whole = sum(map(len, Agent(detector, budget_bytes=None).share(frame)))
    for budget in (whole - 1, whole // 2, 700, 300):
        packets = Agent(detector, budget_bytes=budget).share(frame)
        assert budget - 250 < sum(map(len, packets)) <= budget


def test_the_corrector_gets_the_body_of_ego_and_sender() -> None:
    correction = PoseCorrection()
    ego, sender = Agent(Recorder(), get_strategy("late")), Agent(Recorder(), get_strategy("late"))
    frame = frame_of((30.0, 0.0, 1.5))
    own = correction.extract_own_landmarks(frame, ego.perception_cache)
    assert own.xy[-1].tolist() == [1.4, 0.0] and own.size[-1].tolist() == [4.9, 2.0]
    packets = sender.share(frame_of((10.0, 0.0, 1.5), agent_id=3, body=AgentBody.standing(0.5, 0.1, (4.0, 1.8, 1.5))))
    (received,) = ego.perceive(frame, packets).received
    theirs = correction._message_landmarks(ego.perception_cache, received.message, 0.0)
    assert theirs.xy[-1].tolist() == [0.5, 0.1] and theirs.sigma_xy[-1] < 0.2
