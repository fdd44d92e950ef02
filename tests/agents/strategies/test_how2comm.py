# SPDX-License-Identifier: Apache-2.0
"""How2comm's gate at the sender: it saves bytes where receivers attend, an open one sends all, and it is the gate of training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.agents.test_bandwidth import Plane

from manyeyes.agents.agent import Agent
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.message import RequestMap
from manyeyes.models.detector.box_head import BOX_LAYOUT
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.fusion.transform_tokens import AgentTokens, to_ego_frame

NAMES = ("how2comm", "how2comm/bare")


def weights(fusion: str) -> Detector:
    torch.manual_seed(0)
    return Detector(replace(COSTR_TINY, fusion=fusion, prune_threshold=0.05)).eval().requires_grad_(False)


def share(detector: Detector, requests=(), strategy: str = "intermediate-how2comm"):
    """The frame of a sender and what an ego decodes of its message."""
    frames = Plane().snapshot("plane", 0).frames
    packets = Agent(detector, get_strategy(strategy), "float32", budget_bytes=None).share(frames[2], requests=requests)
    (received,) = Agent(detector, get_strategy(strategy)).perceive(frames[0], packets).received
    return received.message, sum(map(len, packets))


def request(detector: Detector, attention: float):
    """A message of the ego that attends so much everywhere."""
    message, _ = share(detector)
    windows = detector.grid.at(32)
    frame = Plane().snapshot("plane", 0).frames[0]
    wide = RequestMap(windows, torch.full(windows.shape, attention))
    return replace(message, agent_id=0, world_from_agent=frame.world_from_agent, request=wide)


@pytest.mark.parametrize("name", NAMES)
def test_a_sender_saves_the_bytes_of_closed_gates(name: str) -> None:
    """The gate opens with the request alone: an ego that attends everywhere is sent nothing, one that does not all in its range."""
    detector = weights(name)
    gate = detector.fusion.rule.spatial
    gate.combine.weight.copy_(torch.tensor([[40.0, 0.0]]))
    gate.combine.bias.fill_(-20.0)
    _, free = share(detector)
    for attention, part in ((1.0, 0.25), (0.0, 1.001)):
        message, used = share(detector, [request(detector, attention)])
        assert used <= part * free
        assert (len(message.tokens.sites) == 0) == (attention == 1.0)


@pytest.mark.parametrize("name", NAMES)
def test_an_open_gate_sends_what_intermediate_sends(name: str) -> None:
    detector = weights(name)
    detector.fusion.rule.spatial.combine.bias.fill_(50.0)
    gated, plain = share(detector)[0], share(detector, strategy="intermediate")[0]
    assert torch.equal(gated.tokens.features, plain.tokens.features) and gated.request is not None
    assert torch.equal(gated.tokens.sites.key, plain.tokens.sites.key)


@pytest.mark.parametrize("name", NAMES)
def test_the_gate_of_the_sender_is_that_of_training(name: str) -> None:
    """Of a collaborator in the ego's own pose, with the ego's request cell by cell."""
    detector, frame = weights(name), Plane().snapshot("plane", 0).frames[2]
    tokens = Agent(detector).perception_cache.process_tokens(frame).shared_tokens
    own = AgentTokens(0, tokens.features, tokens.sites.xy)
    rows, row = detector.fusion.gather(to_ego_frame([own], tokens.grid, 1))
    expected = detector.fusion.rule.spatial(rows)[row, 0]
    request = 1 - detector.attend_tokens(tokens)
    assert torch.allclose(detector.gate_tokens(tokens, request), expected, atol=1e-6)
    assert 0 <= float(expected.min()) < float(expected.max()) <= 1


def test_a_bare_message_has_the_senders_flow() -> None:
    """Velocities are on the wire, and a delayed row is moved by them."""
    detector, frame = weights("how2comm/bare"), Plane().snapshot("plane", 0).frames[2]
    tokens = Agent(detector).perception_cache.process_tokens(frame).shared_tokens
    columns = detector.encoder.out_channels
    features = tokens.features.clone()
    features[:, columns:][:, BOX_LAYOUT.velocity] = torch.tensor([0.5, -0.25])
    packed = detector.pack_tokens(tokens.with_features(features))
    assert packed.features.shape[1] == columns + 3
    received = detector.unpack_tokens(packed)
    assert torch.equal(
        received.features[:, columns:][:, BOX_LAYOUT.velocity], features[:, columns:][:, BOX_LAYOUT.velocity]
    )
    pose = frame.world_from_agent.inverse() @ frame.world_from_agent
    late, now = (
        to_ego_frame([AgentTokens(0, received.features, received.sites.xy, pose, age_s=age)], tokens.grid, 1)
        for age in (0.4, 0.0)
    )
    assert len(late.xy) and not torch.allclose(late.xy[:5], now.xy[:5])


def test_other_weights_have_no_gate() -> None:
    detector, frame = weights("max"), Plane().snapshot("plane", 0).frames[1]
    as_usual = Agent(detector, get_strategy("intermediate")).share(frame, 1398)
    assert Agent(detector, get_strategy("intermediate-how2comm")).share(frame, 1398) == as_usual
    with pytest.raises(ConfigError, match="no gate"):
        detector.attend_tokens(Agent(detector).perception_cache.process_tokens(frame).shared_tokens)
