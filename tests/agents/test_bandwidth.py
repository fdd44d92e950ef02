# SPDX-License-Identifier: Apache-2.0
"""Few bytes on the whole path: codes from agent to agent, counted as they are handed to the bus, within shared budgets."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.replay import ReplayConfig, replay
from manyeyes.agents.token_codec import quantise_tokens
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, GroundTruth, PointCloud, Sites, Snapshot, Transform
from manyeyes.datatypes.message import RequestMap
from manyeyes.models.checkpoint import fingerprint
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.training.detector.codebook import with_codebook

torch.set_num_threads(1)


class Plane:
    """Three agents on a plane with noise on it: enough for a detector that was never trained."""

    scenarios = ("plane",)

    def length(self, scenario: str) -> int:
        return 2

    def eval_indices(self, scenario: str) -> range:
        return range(2)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (0, 1, 2)

    def snapshot(self, scenario: str, index: int) -> Snapshot:
        poses = [Transform.from_xyz_yaw(8.0 * i, 3.0 * i, 0.0, 0.5 * i) for i in range(3)]
        frames = []
        for i, pose in enumerate(poses):
            rng = torch.Generator().manual_seed(10 * index + i)
            xyz = (torch.rand(400 * (i + 1), 3, generator=rng) - 0.5) * torch.tensor([40.0, 40.0, 1.5])
            frames.append(AgentFrame.of(PointCloud.of(xyz), pose, agent_id=i, timestamp_ns=100_000_000 * index))
        truth = GroundTruth(Boxes.empty(torch.float64), torch.zeros(3, 0, dtype=torch.bool), Transform.stack(poses))
        return Snapshot(scenario, index, tuple(frames), truth)


@pytest.fixture(scope="module")
def detector() -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        plain = Detector(replace(COSTR_TINY, prune_threshold=0.05)).eval().requires_grad_(False)
    plain.fingerprint = fingerprint(plain)
    features = [
        Agent(plain).perception_cache.process(f).shared_tokens.features for f in Plane().snapshot("plane", 0).frames
    ]
    return with_codebook(plain, torch.cat(features), 0, CodebookConfig(3, 64))


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float16", "codebook"])
@pytest.mark.parametrize("channel_bytes", [None, 2500])
def test_the_bytes_of_a_table_are_those_handed_to_the_bus(detector, monkeypatch, precision, channel_bytes):
    """Packet by packet: what a step reports of a sender is the length of every packet that the bus was given, in order."""
    handed: dict[tuple[int, int], tuple[int, ...]] = {}
    publish = LocalBus.publish

    def counted(self, agent_id, position_xy, packets, now_ns):
        handed[now_ns, agent_id] = tuple(map(len, packets))
        publish(self, agent_id, position_xy, packets, now_ns)

    monkeypatch.setattr(LocalBus, "publish", counted)
    config = ReplayConfig(token_encoding=precision, budget_bytes=4096, channel_budget_bytes=channel_bytes)
    steps = list(replay(Plane(), "plane", detector, ["intermediate"], config))
    assert len(steps) == 2
    for step in steps:
        now = step.snapshot.frames[0].timestamp_ns
        assert {s.agent_id: s.packet_sizes for s in step.sent} == {a: v for (t, a), v in handed.items() if t == now}
        assert all(s.num_packets == len(s.packet_sizes) > 0 and s.num_bytes <= 4096 for s in step.sent)
        if channel_bytes is not None:
            assert channel_bytes - 400 < sum(s.num_bytes for s in step.sent) <= channel_bytes
        assert len(step.perception.received) == sum(1 for s in step.sent if s.num_packets and s.agent_id != 0)


def test_codebook_tokens_are_decoded_to_their_values_in_a_tenth_of_the_bytes(detector):
    """All of them: the receiver reads, cell by cell, what the sender's codebook makes of its tokens."""
    frames = Plane().snapshot("plane", 0).frames
    sender = Agent(detector, token_encoding="codebook", budget_bytes=None)
    packets = sender.share(frames[1])
    (received,) = Agent(detector).perceive(frames[0], packets).received
    cache = sender.perception_cache
    tokens = cache.process(cache.level(frames[1]).levelled).shared_tokens
    assert torch.equal(received.message.tokens.sites.key, tokens.sites.key)
    book = detector.codebook
    assert torch.equal(received.message.tokens.features, book.decode(book.encode(tokens.features)))
    whole = Agent(detector, token_encoding="float32", budget_bytes=None).share(frames[1])
    assert sum(map(len, packets)) < 0.12 * sum(map(len, whole))


@pytest.mark.parametrize("precision", ["float16", "codebook"])
def test_a_message_of_tokens_never_exceeds_any_budget_and_a_smaller_one_keeps_a_part(detector, precision):
    frame = Plane().snapshot("plane", 0).frames[2]
    agent, kept = Agent(detector, token_encoding=precision, budget_bytes=None), []
    for budget in (0, 60, 90, 300, 1000, 1398, 4096):
        packets = agent.share(frame, budget)
        assert sum(map(len, packets)) <= budget
        received = Agent(detector).perceive(Plane().snapshot("plane", 0).frames[0], packets).received
        kept.append({k for r in received for k in r.message.tokens.sites.key.tolist()})
    assert all(a <= b for a, b in pairwise(kept)) and 0 < len(kept[-3]) < len(kept[-1])


def test_weights_with_a_codebook_send_codes_by_default(detector):
    """And those without one float16: an agent alone, and one in a recording that is played."""
    plain = Detector(replace(detector.config, codebook=None)).eval()
    frame = Plane().snapshot("plane", 0).frames[1]
    for model, usual in ((detector, "codebook"), (plain, "float16")):
        packets = Agent(model).share(frame)
        assert (
            packets
            == Agent(model, token_encoding=usual).share(frame)
            != Agent(model, token_encoding="float32").share(frame)
        )
        first = next(replay(Plane(), "plane", model, ["intermediate"], ReplayConfig()))
        assert [s.num_bytes for s in first.sent if s.agent_id == 1] == [sum(map(len, packets))]


def test_codes_need_a_codebook_on_both_sides(detector):
    plain = Detector(replace(detector.config, codebook=None)).eval()
    with pytest.raises(ConfigError, match="manyeyes fit-codebook"):
        Agent(plain, token_encoding="codebook")
    frames = Plane().snapshot("plane", 0).frames
    with pytest.raises(ConfigError, match="manyeyes fit-codebook"):
        quantise_tokens(Agent(plain).perception_cache.process(frames[0]).shared_tokens, plain)
    packets = Agent(detector, token_encoding="codebook").share(frames[1])
    # Without the tables coded packets are of other weights; and rows of another width mean nothing here.
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    assert inbox.dropped.wrong_model == len(packets)
    inbox = Inbox(tables=Agent(detector).token_format.tables)
    inbox.push(packets[0])
    assert Agent(plain).perceive(frames[0], inbox).received[0].message.tokens is None


def test_request_maps_are_counted_and_change_the_selection(detector):
    """Where all windows are seen well, all tokens are worth the same less, and the order stays; a window seen well loses cells."""
    frames = Plane().snapshot("plane", 0).frames
    asking = Agent(detector, budget_bytes=4096, send_request_map=True)
    packets = asking.share(frames[0])
    assert sum(map(len, packets)) <= 4096
    (received,) = Agent(detector).perceive(frames[1], packets).received
    request = received.message.request
    assert request is not None and request.grid == detector.config.grid.at(32)

    def sent(confidence: torch.Tensor | None) -> Sites:
        message = replace(
            received.message, request=None if confidence is None else RequestMap(request.grid, confidence)
        )
        packets = Agent(detector).share(frames[1], 1398, [message])
        return Agent(detector).perceive(frames[0], packets).received[0].message.tokens.sites

    assert torch.equal(sent(None).key, sent(torch.ones(request.grid.shape)).key)
    nowhere = sent(torch.zeros(request.grid.shape))
    # The windows, in the asking agent's frame, of what was sent.
    there = (frames[0].world_from_agent.inverse() @ frames[1].world_from_agent).apply(
        torch.cat((nowhere.xy, torch.zeros(len(nowhere), 1)), 1).double()
    )
    yx = request.grid.cells(there[:, :2])
    confidence = torch.zeros(request.grid.shape)
    confidence[yx[0, 0], yx[0, 1]] = 1.0
    assert int(nowhere.key[0]) not in sent(confidence).key.tolist()


def test_requests_of_a_replay_reach_all_senders(detector):
    config = ReplayConfig(token_encoding="codebook", budget_bytes=1398, send_request_map=True)
    steps = list(replay(Plane(), "plane", detector, ["intermediate"], config))
    assert all(r.message.request is not None for step in steps for r in step.perception.received)
    assert all(s.num_bytes <= 1398 for step in steps for s in step.sent)
