# SPDX-License-Identifier: Apache-2.0
"""Descriptors on the way from one agent to another: their bytes, their budget, and a pose that is found by them alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents import pose_correction as module
from manyeyes.agents.agent import Agent
from manyeyes.agents.descriptors import seen_points, told_points
from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.pose_correction import Aligner, Use
from manyeyes.agents.strategies import METHODS
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, PointCloud, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR
from manyeyes.models import checkpoint
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypoints
from manyeyes.models.pose.feakm import FORMAT, FeakmConfig, FeakmNet, Matches
from manyeyes.models.pose.matcher import MatcherConfig, Points
from manyeyes.pose.feakm import Feakm
from manyeyes.pose.types import PoseStatus

CHANNELS = COSTR_TINY.encoder.channels[2]
NET = FeakmConfig(BoxKeypoints(CHANNELS, DESCRIPTOR, 16, score_min=0.1, most=6), MatcherConfig(DESCRIPTOR, 16, 1, 1))


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("feakm") / "net.safetensors"
    torch.manual_seed(0)
    checkpoint.save(FeakmNet(NET), path, {}, format=FORMAT)
    return str(path)


def heard(detector, packets) -> Message:
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    (reception,) = inbox.receptions()
    return reception.message


def test_tokens_gain_45_bytes_an_object_that_the_net_describes(drive, detector, weights):
    frame, aligner = drive().frame(1, 3), Aligner(weights)
    plain, says = (Agent(detector, budget_bytes=None, aligner=a) for a in (None, aligner))
    sizes = [sum(map(len, agent.share(frame))) for agent in (plain, says)]
    points = seen_points(aligner.net, says.eyes, frame)
    message = heard(detector, says.share(frame))
    assert len(points) == 6 and len(message.objects) == 6
    velocity = 4 * bool(points.boxes.velocity.any())
    # A packet more or less has a header.
    assert 0 <= sizes[1] - sizes[0] - (45 + velocity) * 6 < 100
    torch.testing.assert_close(message.descriptors, points.descriptor, atol=0.5 / 127 + 1e-6, rtol=0)
    torch.testing.assert_close(
        message.objects.center[:, :2], points.boxes.center[:, :2], atol=0.0051, rtol=0, check_dtype=False
    )


def test_a_budget_holds_with_what_is_described(drive, detector, weights):
    frame = drive().frame(1, 3)
    agent = Agent(detector, budget_bytes=1800, aligner=Aligner(weights))
    packets = agent.share(frame)
    message = heard(detector, packets)
    assert sum(map(len, packets)) <= 1800 and len(message.objects) == 6 and len(message.tokens.sites) > 0
    assert Agent(detector, budget_bytes=200, aligner=Aligner(weights)).share(frame) == []


def test_boxes_that_are_sent_anyway_are_described_and_stay(drive, detector, weights):
    frame, net = drive().frame(1, 3), Aligner(weights).net
    plain, says = (Agent(detector, METHODS["late"], aligner=a) for a in (None, Aligner(weights)))
    was, message = heard(detector, plain.share(frame)), heard(detector, says.share(frame))
    torch.testing.assert_close(message.objects.center, was.objects.center)
    assert len(message.objects) > 6 and int(message.descriptors.any(1).sum()) == 6
    told = told_points(message)
    torch.testing.assert_close(
        told.descriptor, seen_points(net, says.eyes, frame).descriptor, atol=0.5 / 127 + 1e-6, rtol=0
    )


def test_what_is_dated_otherwise_or_says_nothing_is_not_described(drive, detector, weights):
    frame, aligner, eyes = drive().frame(1, 3), Aligner(weights), Eyes(detector)
    message = replace(METHODS["intermediate"].say(eyes, frame), timestamp_ns=frame.timestamp_ns - 1)
    assert aligner.describe(frame, eyes, message) is message and told_points(message) is None
    assert Aligner().describe(frame, eyes, message) is message
    found = aligner.align(drive().frame(0, 3), Eyes(detector), [message], {})
    assert found.verdicts[0].estimate.status is PoseStatus.NO_MATCH


def test_nets_that_messages_cannot_carry_or_that_saw_with_other_eyes_are_refused(drive, detector):
    frame, eyes = drive().frame(1, 3), Eyes(detector)
    long = FeakmNet(replace(NET, keypoints=BoxKeypoints(CHANNELS, 64, 16), matcher=MatcherConfig(64, 16, 1, 1)))
    with pytest.raises(ConfigError, match="32 numbers each; this net has 64"):
        seen_points(long, eyes, frame)
    with pytest.raises(ConfigError, match="taught on views of the weights abab"):
        seen_points(FeakmNet(replace(NET, detector="ab" * 8)), eyes, frame)
    seen_points(FeakmNet(replace(NET, detector=detector.fingerprint.hex())), eyes, frame)


class Looking(FeakmNet):
    """Takes points for one object that look alike, and cannot err."""

    def match(self, ego: Points, other: Points) -> Matches:
        alike = ego.descriptor[0] @ other.descriptor[0].mT
        best, row = alike.max(1)
        rows = (best > 0.9).nonzero()[:, 0]
        return Matches(torch.stack((rows, row[rows]), 1), best[rows])


def test_a_wrong_claim_is_corrected_by_looks_alone(drive, detector, weights, monkeypatch):
    """Twelve cars, of which both see eight; bytes in between."""
    rng = np.random.default_rng(0)
    ego_pose, pose = Transform.from_xyz_yaw(100, 50, 0, 0.3), Transform.from_xyz_yaw(112, 58, 0, 2.8)
    center = np.column_stack((100 + rng.uniform(-25, 25, 12), 50 + rng.uniform(-25, 25, 12), np.full(12, 0.8)))
    size, yaw = np.tile((4.5, 1.9, 1.6), (12, 1)), rng.uniform(-3, 3, 12)
    world = Boxes.of(*map(torch.from_numpy, (center, size, yaw)))
    looks = torch.nn.functional.normalize(torch.randn(12, DESCRIPTOR, generator=torch.Generator().manual_seed(1)))
    own, theirs = slice(0, 10), slice(2, 12)
    frame = AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), ego_pose, agent_id=1)
    off = Transform(pose.rotation, pose.translation + torch.tensor([8.0, -5.0, 0.0]).double())
    objects = world[theirs].transform(pose.inverse())
    message = Message(2, 0, off, torch.eye(3).double() * 36, objects=objects, descriptors=looks[theirs])
    message = heard(detector, wire.encode(message))
    points = Keypoints(world[own].transform(ego_pose.inverse()), looks[own])
    monkeypatch.setattr(module, "seen_points", lambda net, eyes, frame: points)
    by_looks = Feakm.of(Looking(NET))
    monkeypatch.setattr(module, "corrector", lambda name: by_looks)
    found = Aligner(weights).align(frame, Eyes(detector), [message], {})
    (kept,), (verdict,) = found.messages, found.verdicts
    assert verdict.use is Use.CORRECTED and verdict.estimate.inliers == 8
    assert float((kept.world_from_agent.translation - pose.translation)[:2].norm()) < 0.02
    silent = Aligner(weights).align(frame, Eyes(detector), [replace(message, descriptors=None)], {})
    assert silent.verdicts[0].use is Use.UNSURE
