# SPDX-License-Identifier: Apache-2.0
"""Descriptors on the way from one agent to another: their bytes, their budget, and a pose that is found by them alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from manyeyes.agents import pose_correction as module
from manyeyes.agents.agent import Agent
from manyeyes.agents.descriptors import extract_message_keypoints, extract_own_keypoints
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.pose_correction import MessageUse, PoseCorrection
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms import wire
from manyeyes.comms.inbox import Inbox
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message, PointCloud, Transform
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR_DIM
from manyeyes.models import checkpoint
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FORMAT, FeakmConfig, FeakmNet, Matches
from manyeyes.models.pose.matcher import KeypointBatch, MatcherConfig
from manyeyes.pose.feakm import FeakmCorrector
from manyeyes.pose.types import PoseStatus

CHANNELS = COSTR_TINY.encoder.channels[2]
NET = FeakmConfig(
    BoxKeypointConfig(CHANNELS, DESCRIPTOR_DIM, 16, min_score=0.1, max_keypoints=6),
    MatcherConfig(DESCRIPTOR_DIM, 16, 1, 1),
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("feakm") / "net.safetensors"
    torch.manual_seed(0)
    checkpoint.save(FeakmNet(NET), path, {}, format=FORMAT)
    return str(path)


def decode_message(detector, packets) -> Message:
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    (reception,) = inbox.received_messages()
    return reception.message


@pytest.mark.slow
def test_tokens_gain_45_bytes_an_object_that_the_net_describes(drive, detector, weights):
    frame, aligner = drive().frame(1, 3), PoseCorrection(weights)
    plain, describing = (Agent(detector, budget_bytes=None, pose_correction=a) for a in (None, aligner))
    sizes = [sum(map(len, agent.share(frame))) for agent in (plain, describing)]
    points = extract_own_keypoints(aligner.net, describing.perception_cache, frame)
    message = decode_message(detector, describing.share(frame))
    assert len(points) == 6 and len(message.objects) == 6
    velocity = 4 * bool(points.boxes.velocity.any())
    # A packet more or less has a header.
    assert 0 <= sizes[1] - sizes[0] - (45 + velocity) * 6 < 100
    torch.testing.assert_close(message.descriptors, points.descriptor, atol=0.5 / 127 + 1e-6, rtol=0)
    torch.testing.assert_close(
        message.objects.center[:, :2], points.boxes.center[:, :2], atol=0.0051, rtol=0, check_dtype=False
    )


def test_messages_with_descriptors_are_within_the_budget(drive, detector, weights):
    frame = drive().frame(1, 3)
    agent = Agent(detector, budget_bytes=1800, pose_correction=PoseCorrection(weights))
    packets = agent.share(frame)
    message = decode_message(detector, packets)
    assert sum(map(len, packets)) <= 1800 and len(message.objects) == 6 and len(message.tokens.sites) > 0
    assert Agent(detector, budget_bytes=200, pose_correction=PoseCorrection(weights)).share(frame) == []


@pytest.mark.slow
def test_boxes_that_are_sent_anyway_are_described_and_stay(drive, detector, weights):
    frame, net = drive().frame(1, 3), PoseCorrection(weights).net
    plain, describing = (
        Agent(detector, get_strategy("late"), pose_correction=a) for a in (None, PoseCorrection(weights))
    )
    was, message = decode_message(detector, plain.share(frame)), decode_message(detector, describing.share(frame))
    torch.testing.assert_close(message.objects.center, was.objects.center)
    assert len(message.objects) > 6 and int(message.descriptors.any(1).sum()) == 6
    keypoints = extract_message_keypoints(message)
    torch.testing.assert_close(
        keypoints.descriptor,
        extract_own_keypoints(net, describing.perception_cache, frame).descriptor,
        atol=0.5 / 127 + 1e-6,
        rtol=0,
    )


def test_messages_of_another_time_or_without_objects_get_no_descriptors(drive, detector, weights):
    frame, aligner, cache = drive().frame(1, 3), PoseCorrection(weights), PerceptionCache(detector)
    message = replace(get_strategy("intermediate").compose_message(cache, frame), timestamp_ns=frame.timestamp_ns - 1)
    assert aligner.attach_descriptors(frame, cache, message) is message and extract_message_keypoints(message) is None
    assert PoseCorrection().attach_descriptors(frame, cache, message) is message
    found = aligner.correct(drive().frame(0, 3), PerceptionCache(detector), [message], {})
    assert found.corrections[0].estimate.status is PoseStatus.NO_MATCH


def test_nets_with_other_descriptors_or_other_weights_are_refused(drive, detector):
    frame, cache = drive().frame(1, 3), PerceptionCache(detector)
    long = FeakmNet(replace(NET, keypoints=BoxKeypointConfig(CHANNELS, 64, 16), matcher=MatcherConfig(64, 16, 1, 1)))
    with pytest.raises(ConfigError, match="32 numbers each; this net has 64"):
        extract_own_keypoints(long, cache, frame)
    with pytest.raises(ConfigError, match="trained on views of the weights abab"):
        extract_own_keypoints(FeakmNet(replace(NET, detector="ab" * 8)), cache, frame)
    extract_own_keypoints(FeakmNet(replace(NET, detector=detector.fingerprint.hex())), cache, frame)


class DescriptorMatcher(FeakmNet):
    """Matches points with equal descriptors, without error."""

    def match(self, ego_keypoints: KeypointBatch, other_keypoints: KeypointBatch) -> Matches:
        alike = ego_keypoints.descriptor[0] @ other_keypoints.descriptor[0].mT
        best, row = alike.max(1)
        rows = (best > 0.9).nonzero()[:, 0]
        return Matches(torch.stack((rows, row[rows]), 1), best[rows])


def test_a_wrong_prior_pose_is_corrected_by_descriptors_only(drive, detector, weights, monkeypatch):
    """Twelve cars, of which both agents detect eight; exchanged as packets."""
    rng = np.random.default_rng(0)
    ego_pose, pose = Transform.from_xyz_yaw(100, 50, 0, 0.3), Transform.from_xyz_yaw(112, 58, 0, 2.8)
    center = np.column_stack((100 + rng.uniform(-25, 25, 12), 50 + rng.uniform(-25, 25, 12), np.full(12, 0.8)))
    size, yaw = np.tile((4.5, 1.9, 1.6), (12, 1)), rng.uniform(-3, 3, 12)
    world = Boxes.of(*map(torch.from_numpy, (center, size, yaw)))
    descriptors = torch.nn.functional.normalize(
        torch.randn(12, DESCRIPTOR_DIM, generator=torch.Generator().manual_seed(1))
    )
    own, theirs = slice(0, 10), slice(2, 12)
    frame = AgentFrame.of(PointCloud.of(torch.zeros(1, 3)), ego_pose, agent_id=1)
    off = Transform(pose.rotation, pose.translation + torch.tensor([8.0, -5.0, 0.0]).double())
    objects = world[theirs].transform(pose.inverse())
    message = Message(2, 0, off, torch.eye(3).double() * 36, objects=objects, descriptors=descriptors[theirs])
    message = decode_message(detector, wire.encode(message))
    points = Keypoints(world[own].transform(ego_pose.inverse()), descriptors[own])
    monkeypatch.setattr(module, "extract_own_keypoints", lambda net, cache, frame: points)
    by_descriptors = FeakmCorrector.of(DescriptorMatcher(NET))
    monkeypatch.setattr(module, "load_corrector", lambda name: by_descriptors)
    found = PoseCorrection(weights).correct(frame, PerceptionCache(detector), [message], {})
    (kept,), (verdict,) = found.messages, found.corrections
    assert verdict.use is MessageUse.CORRECTED and verdict.estimate.inliers == 8
    assert float((kept.world_from_agent.translation - pose.translation)[:2].norm()) < 0.02
    silent = PoseCorrection(weights).correct(frame, PerceptionCache(detector), [replace(message, descriptors=None)], {})
    assert silent.corrections[0].use is MessageUse.UNCERTAIN
