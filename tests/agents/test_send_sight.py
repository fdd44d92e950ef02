# SPDX-License-Identifier: Apache-2.0
"""The sight that an agent sends: off by default, counted within its budget, and of the levelled frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tests.agents.conftest import Drive, tiny_detector
from tests.agents.trust.street import SEEN, cars, scan, wall

from manyeyes.agents.agent import Agent
from manyeyes.agents.replay import DetectionReplay, ReplayConfig
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.payloads import SIGHT
from manyeyes.comms.wire import SIGHT_PACKET_BYTES
from manyeyes.datatypes import AgentFrame, Boxes, PointCloud, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.ops.lidar.free_range import measure_sight
from manyeyes.studies.replay_options import ReplayOptions

STRATEGIES = ("late", "intermediate", "early")


@pytest.fixture(scope="module")
def detector() -> Detector:
    return tiny_detector()


@pytest.fixture(scope="module")
def frames() -> tuple[AgentFrame, ...]:
    """Agents on the street of the trust tests, 25 m apart."""
    points = scan(Boxes.cat([cars(SEEN), wall()]))
    poses = [Transform.from_xyz_yaw(25.0 * row, 0.0) for row in range(2)]
    return tuple(AgentFrame.of(PointCloud.of(points), pose, row) for row, pose in enumerate(poses))


def sights(packets: list[bytes]) -> list[bytes]:
    return [packet for packet in packets if packet[3] & 7 == SIGHT]


@pytest.mark.parametrize("name", STRATEGIES)
def test_no_agent_sends_it_by_default_and_any_message_can_carry_it(detector, frames, name):
    plain = Agent(detector, get_strategy(name)).share(frames[0])
    packets = Agent(detector, get_strategy(name), send_sight=True).share(frames[0])
    assert not sights(plain) and len(sights(packets)) == 1
    (received,) = Agent(detector, get_strategy(name)).perceive(frames[1], packets).received
    level = Agent(detector).perception_cache.level(frames[0]).levelled
    wanted = measure_sight(level.points.xyz, level.sensor_height_m)
    assert received.message.sight is not None and np.array_equal(received.message.sight.steps, wanted.steps)
    assert 1 < wanted.free_m[179] < 14.0 and wanted.free_m.max() > 50, "the car ahead at 12.75 m ends the free range"


def test_without_fusion_nothing_is_sent(detector, frames):
    assert Agent(detector, get_strategy("no-fusion"), send_sight=True).share(frames[0]) == []


@pytest.mark.parametrize("budget", [600, 1398, 4096])
def test_the_budget_includes_it(detector, frames, budget):
    agent = Agent(detector, get_strategy("intermediate"), "float16", budget, send_sight=True)
    packets = agent.share(frames[0])
    assert len(sights(packets)) == 1 and sum(map(len, packets)) <= budget
    assert SIGHT_PACKET_BYTES == 248


def test_boxes_do_not_change_where_no_agent_assesses_senders(detector, frames):
    def boxes(send_sight: bool) -> torch.Tensor:
        packets = Agent(detector, get_strategy("late"), send_sight=send_sight).share(frames[1])
        return Agent(detector, get_strategy("late")).perceive(frames[0], packets).boxes.bev()

    assert torch.equal(boxes(False), boxes(True))


def test_agents_of_a_replay_send_it_within_a_budget_of_all_content(detector):
    config = ReplayConfig(budget_bytes=500, send_sight=True, limits_contents=True)
    steps = list(DetectionReplay("late", detector, config).step(Drive().snapshot(0)))
    assert steps and all(r.message.sight is not None for step in steps for r in step.perception.received)
    assert all(sent.num_bytes <= 500 for step in steps for sent in step.sent)


def test_the_option_of_commands_is_off():
    assert not ReplayOptions().make_replay_config(0).send_sight
    assert ReplayOptions(sight=True).make_replay_config(0).send_sight
