# SPDX-License-Identifier: Apache-2.0
"""Implausible poses are unknown: fused after an estimate from objects, else excluded by name."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.pose_correction import MessageUse, PoseCorrection
from manyeyes.agents.pose_plausibility import AcceptedPose, accept_poses, find_pose_fault, with_unknown_pose
from manyeyes.agents.strategies.late import LateFusion
from manyeyes.comms import wire
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import AgentFrame, Boxes, Message, PointCloud, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import list_correctors, load_corrector

LIMITS = ReceiverLimits()
EGO = Transform.from_xyz_yaw(100.0, 50.0, 0.0, 0.3)
SENDER = Transform.from_xyz_yaw(112.0, 58.0, 0.0, 2.8)
SECOND_NS = 1_000_000_000


class FixedBoxesCache(PerceptionCache):
    """A perception cache whose detections are given."""

    def __init__(self, boxes: Boxes) -> None:
        super().__init__(Detector(COSTR_TINY))
        self.boxes = boxes

    def process(self, frame: AgentFrame) -> Any:
        return self


def cars() -> Boxes:
    """Twelve cars in the world within 18 m of the ego."""
    rng = np.random.default_rng(0)
    center = np.column_stack((100 + rng.uniform(-18, 18, 12), 50 + rng.uniform(-18, 18, 12), np.full(12, 0.8)))
    size = np.column_stack((rng.uniform(4, 5.2, 12), rng.uniform(1.7, 2.1, 12), np.full(12, 1.6)))
    found = Boxes.of(*map(torch.from_numpy, (center, size)), torch.from_numpy(rng.uniform(-3, 3, 12)))
    sigma = torch.full((12,), 0.1, dtype=torch.float64)
    return replace(found, sigma_xy=sigma, sigma_yaw=sigma * 0.2, p_flip=sigma * 0.1)


def frame(time_ns: int = 0) -> AgentFrame:
    return replace(AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), EGO, agent_id=1), timestamp_ns=time_ns)


def message(pose: Transform = SENDER, time_ns: int = 0, sigma_m: float = 0.0, sigma_yaw: float = 0.0) -> Message:
    """What the sender detects from its true pose, with a stated pose."""
    covariance = torch.diag(torch.tensor([sigma_m, sigma_m, sigma_yaw]).double() ** 2)
    return Message(2, time_ns, pose, covariance, objects=cars().transform(SENDER.inverse()))


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Transform:
    return Transform(SENDER.rotation, SENDER.translation + torch.tensor([x, y, z]).double())


def tilted(degrees: float) -> Transform:
    zero = torch.zeros((), dtype=torch.float64)
    turn = Transform.from_rpy(torch.zeros(3).double(), zero + math.radians(degrees), zero, zero)
    return SENDER @ turn


FAULTS = {
    "1e6 m above": (moved(z=1e6), "above the receiver"),
    "60 m below": (moved(z=-60.0), "above the receiver"),
    "1e15 m away": (moved(x=1e15), "away"),
    "2 km away": (moved(y=-2e3), "away"),
    "upside down": (tilted(180.0), "tilted"),
    "on its side": (tilted(90.0), "tilted"),
    "not a number": (moved(x=math.nan), "away"),
}
PLAUSIBLE = {"true": SENDER, "on a slope": tilted(15.0), "on a bridge": moved(z=20.0), "at 500 m": moved(x=500.0)}


@pytest.mark.parametrize("name", FAULTS)
def test_an_implausible_pose_has_a_fault(name: str) -> None:
    pose, text = FAULTS[name]
    assert text in str(find_pose_fault(frame(), message(pose), None, LIMITS))


@pytest.mark.parametrize("name", PLAUSIBLE)
def test_a_plausible_pose_has_no_fault(name: str) -> None:
    assert find_pose_fault(frame(), message(PLAUSIBLE[name]), None, LIMITS) is None


@pytest.mark.parametrize("sigmas, plausible", [((4.9, 0.49), True), ((5.1, 0.0), False), ((0.0, 0.51), False)])
def test_a_large_stated_covariance_is_a_fault(sigmas: tuple[float, float], plausible: bool) -> None:
    fault = find_pose_fault(frame(), message(sigma_m=sigmas[0], sigma_yaw=sigmas[1]), None, LIMITS)
    assert (fault is None) is plausible
    assert find_pose_fault(frame(), with_unknown_pose(message()), None, LIMITS) is not None


@pytest.mark.parametrize("metres, plausible", [(0.0, True), (16.0, True), (18.0, False), (900.0, False)])
def test_a_sender_moves_by_its_speed_and_a_small_jump_at_most(metres: float, plausible: bool) -> None:
    """70 m/s for 0.1 s, and 10 m."""
    last = AcceptedPose.of(message())
    fault = find_pose_fault(frame(), message(moved(x=metres), time_ns=SECOND_NS // 10), last, LIMITS)
    assert (fault is None) is plausible and (plausible or "moved by" in str(fault))


def test_a_sender_that_was_displaced_is_accepted_again_after_a_while() -> None:
    last = AcceptedPose.of(message())
    assert find_pose_fault(frame(), message(moved(x=100.0), time_ns=SECOND_NS), last, LIMITS)
    assert find_pose_fault(frame(), message(moved(x=100.0), time_ns=2 * SECOND_NS), last, LIMITS) is None
    poses = accept_poses({}, [message(), replace(with_unknown_pose(message()), agent_id=3)], 0)
    assert set(poses) == {2} and not accept_poses(poses, [], 3 * SECOND_NS)


@pytest.mark.parametrize("name", FAULTS)
def test_a_message_of_unknown_pose_is_used_at_its_estimated_pose(name: str) -> None:
    """Its prior pose is not used: it was fused at it, or the corrector raised."""
    unknown = with_unknown_pose(message(FAULTS[name][0]))
    found = PoseCorrection().correct(frame(), FixedBoxesCache(cars().transform(EGO.inverse())), [unknown], {})
    (kept,), (correction,) = found.messages, found.corrections
    assert correction.use is MessageUse.CORRECTED
    assert float((kept.world_from_agent.translation - SENDER.translation).norm()) < 0.1
    assert bool(kept.pose_covariance.isfinite().all())


def test_two_senders_of_which_one_has_an_unknown_pose_are_corrected_jointly() -> None:
    unknown = replace(with_unknown_pose(message(moved(z=1e6))), agent_id=3)
    cache = FixedBoxesCache(cars().transform(EGO.inverse()))
    for messages in ([message(sigma_m=0.3), unknown], [unknown, replace(unknown, agent_id=4)]):
        found = PoseCorrection().correct(frame(), cache, messages, {})
        assert len(found.messages) == 2
        for kept in found.messages:
            assert float((kept.world_from_agent.translation - SENDER.translation).norm()) < 0.2


def test_a_message_of_unknown_pose_without_common_objects_is_excluded() -> None:
    unknown = with_unknown_pose(message())
    found = PoseCorrection().correct(frame(), FixedBoxesCache(Boxes.empty(torch.float64)), [unknown], {})
    assert not found.messages and found.corrections[0].use is MessageUse.UNCERTAIN


@pytest.mark.parametrize("name", list_correctors("landmarks"))
def test_every_corrector_bears_a_message_without_a_prior(name: str) -> None:
    own, other = (Landmarks.of_boxes(cars().transform(pose.inverse())) for pose in (EGO, SENDER))
    estimate = load_corrector(name)(own, other, None)
    assert estimate.ego_from_other is None or bool(estimate.ego_from_other.matrix().isfinite().all())


def perceive(stated: Transform, correction: PoseCorrection | None, sender: int = 2):
    cache = FixedBoxesCache(cars().transform(EGO.inverse())[:6])
    agent = Agent(cache.detector, LateFusion(), perception_cache=cache, pose_correction=correction)
    packets = wire.encode(replace(message(stated), agent_id=sender))
    return agent.perceive(frame(), packets)


@pytest.mark.parametrize("name", ["1e6 m above", "upside down", "2 km away"])
def test_a_sender_of_implausible_pose_is_rejected_by_name_or_corrected(name: str) -> None:
    honest, stated = perceive(SENDER, None), FAULTS[name][0]
    assert honest.rejected == () and len(honest.boxes) > 6
    alone = perceive(stated, None)
    assert [(r.agent_id, r.reason) for r in alone.rejected] == [(2, "pose")] and FAULTS[name][1] in alone.rejected[
        0
    ].text
    assert alone.received == () and len(alone.boxes) == 6
    corrected = perceive(stated, PoseCorrection())
    assert corrected.rejected == () and [r.message.agent_id for r in corrected.received] == [2]
    nearest = torch.cdist(honest.boxes.center, corrected.boxes.center).min(1).values
    assert len(corrected.boxes) == len(honest.boxes) and float(nearest.max()) < 0.3
