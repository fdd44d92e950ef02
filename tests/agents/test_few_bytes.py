# SPDX-License-Identifier: Apache-2.0
"""Few bytes on the whole path: codes from agent to agent, counted as they are handed to the bus, within shared budgets."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.replay import ReplayConfig, replay
from manyeyes.agents.token_codec import coded
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.local_bus import LocalBus
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, PointCloud, Sites, Snapshot, Transform, Truth
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

    def judged(self, scenario: str) -> range:
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
        truth = Truth(Boxes.empty(torch.float64), torch.zeros(3, 0, dtype=torch.bool), Transform.stack(poses))
        return Snapshot(scenario, index, tuple(frames), truth)


@pytest.fixture(scope="module")
def detector() -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        plain = Detector(replace(COSTR_TINY, prune_threshold=0.05)).eval().requires_grad_(False)
    plain.fingerprint = fingerprint(plain)
    told = [Agent(plain).eyes.see(f).told.features for f in Plane().snapshot("plane", 0).frames]
    return with_codebook(plain, torch.cat(told), 0, CodebookConfig(3, 64))


@pytest.mark.parametrize("precision", ["float16", "codes"])
@pytest.mark.parametrize("channel_bytes", [None, 2500])
def test_the_bytes_of_a_table_are_those_handed_to_the_bus(detector, monkeypatch, precision, channel_bytes):
    """Packet by packet: what a step reports of a sender is the length of every packet that the bus was given, in order."""
    handed: dict[tuple[int, int], tuple[int, ...]] = {}
    publish = LocalBus.publish

    def counted(self, agent_id, position_xy, packets, now_ns):
        handed[now_ns, agent_id] = tuple(map(len, packets))
        publish(self, agent_id, position_xy, packets, now_ns)

    monkeypatch.setattr(LocalBus, "publish", counted)
    config = ReplayConfig(precision=precision, budget_bytes=4096, channel_bytes=channel_bytes)
    steps = list(replay(Plane(), "plane", detector, ["intermediate"], config))
    assert len(steps) == 2
    for step in steps:
        now = step.snapshot.frames[0].timestamp_ns
        assert {s.agent_id: s.sizes for s in step.sent} == {a: v for (t, a), v in handed.items() if t == now}
        assert all(s.packets == len(s.sizes) > 0 and s.bytes <= 4096 for s in step.sent)
        if channel_bytes is not None:
            assert channel_bytes - 400 < sum(s.bytes for s in step.sent) <= channel_bytes
        assert len(step.perception.heard) == sum(1 for s in step.sent if s.packets and s.agent_id != 0)


def test_codes_arrive_as_what_they_stand_for_in_a_tenth_of_the_bytes(detector):
    """All of them: the receiver reads, cell by cell, what the sender's codebook makes of its tokens."""
    frames = Plane().snapshot("plane", 0).frames
    sender = Agent(detector, precision="codes", budget_bytes=None)
    packets = sender.share(frames[1])
    (heard,) = Agent(detector).perceive(frames[0], packets).heard
    told = sender.eyes.see(frames[1]).told
    assert torch.equal(heard.message.tokens.sites.key, told.sites.key)
    book = detector.codebook
    assert torch.equal(heard.message.tokens.features, book.read(book.write(told.features)))
    whole = Agent(detector, precision="float32", budget_bytes=None).share(frames[1])
    assert sum(map(len, packets)) < 0.12 * sum(map(len, whole))


@pytest.mark.parametrize("precision", ["float16", "codes"])
def test_a_message_of_tokens_never_exceeds_any_budget_and_a_smaller_one_keeps_a_part(detector, precision):
    frame = Plane().snapshot("plane", 0).frames[2]
    agent, kept = Agent(detector, precision=precision, budget_bytes=None), []
    for budget in (0, 60, 90, 300, 1000, 1398, 4096):
        packets = agent.share(frame, budget)
        assert sum(map(len, packets)) <= budget
        heard = Agent(detector).perceive(Plane().snapshot("plane", 0).frames[0], packets).heard
        kept.append({k for r in heard for k in r.message.tokens.sites.key.tolist()})
    assert all(a <= b for a, b in pairwise(kept)) and 0 < len(kept[-3]) < len(kept[-1])


def test_weights_with_a_codebook_send_codes_unless_told_otherwise(detector):
    """And those without one float16: an agent alone, and one in a recording that is played."""
    plain = Detector(replace(detector.config, codebook=None)).eval()
    frame = Plane().snapshot("plane", 0).frames[1]
    for model, usual in ((detector, "codes"), (plain, "float16")):
        packets = Agent(model).share(frame)
        assert packets == Agent(model, precision=usual).share(frame) != Agent(model, precision="float32").share(frame)
        first = next(replay(Plane(), "plane", model, ["intermediate"], ReplayConfig()))
        assert [s.bytes for s in first.sent if s.agent_id == 1] == [sum(map(len, packets))]


def test_codes_need_a_codebook_on_both_sides(detector):
    plain = Detector(replace(detector.config, codebook=None)).eval()
    with pytest.raises(ConfigError, match="manyeyes quantise"):
        Agent(plain, precision="codes")
    frames = Plane().snapshot("plane", 0).frames
    with pytest.raises(ConfigError, match="manyeyes quantise"):
        coded(Agent(plain).eyes.see(frames[0]).told, plain)
    packets = Agent(detector, precision="codes").share(frames[1])
    # Without the tables coded packets are of other weights; and rows of another width mean nothing here.
    inbox = Inbox(detector.fingerprint)
    for packet in packets:
        inbox.push(packet)
    assert inbox.dropped.wrong_model == len(packets)
    inbox = Inbox(tables=Agent(detector)._tables)
    inbox.push(packets[0])
    assert Agent(plain).perceive(frames[0], inbox).heard[0].message.tokens is None


def test_requests_are_counted_and_change_what_is_sent(detector):
    """Where all windows are seen well, all tokens are worth the same less, and the order stays; a window seen well loses cells."""
    frames = Plane().snapshot("plane", 0).frames
    asking = Agent(detector, budget_bytes=4096, requests=True)
    packets = asking.share(frames[0])
    assert sum(map(len, packets)) <= 4096
    (heard,) = Agent(detector).perceive(frames[1], packets).heard
    request = heard.message.request
    assert request is not None and request.grid == detector.config.grid.at(32)

    def sent(sure: torch.Tensor | None) -> Sites:
        said = replace(heard.message, request=None if sure is None else RequestMap(request.grid, sure))
        told = Agent(detector).share(frames[1], 1398, [said])
        return Agent(detector).perceive(frames[0], told).heard[0].message.tokens.sites

    assert torch.equal(sent(None).key, sent(torch.ones(request.grid.shape)).key)
    nowhere = sent(torch.zeros(request.grid.shape))
    # The windows, in the asking agent's frame, of what was sent.
    there = (frames[0].world_from_agent.inverse() @ frames[1].world_from_agent).apply(
        torch.cat((nowhere.xy, torch.zeros(len(nowhere), 1)), 1).double()
    )
    yx = request.grid.cells(there[:, :2])
    sure = torch.zeros(request.grid.shape)
    sure[yx[0, 0], yx[0, 1]] = 1.0
    assert int(nowhere.key[0]) not in sent(sure).key.tolist()


def test_requests_of_a_replay_are_heard_by_those_who_share(detector):
    config = ReplayConfig(precision="codes", budget_bytes=1398, requests=True)
    steps = list(replay(Plane(), "plane", detector, ["intermediate"], config))
    assert all(r.message.request is not None for step in steps for r in step.perception.heard)
    assert all(s.bytes <= 1398 for step in steps for s in step.sent)
