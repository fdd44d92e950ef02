# SPDX-License-Identifier: Apache-2.0
"""Encoded is counted, for every registered method: reported bytes are those on the bus, receivers decode what senders
encoded, and a process of its own finds the same boxes in recorded bytes.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import pytest
import torch

from manyeyes.agents.agent import Agent
from manyeyes.agents.exchange import Exchange
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.replay import ReplayConfig, replay
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.agents.token_codec import decode_tokens, default_token_encoding
from manyeyes.comms import wire
from manyeyes.comms.inbox import ReceivedMessage
from manyeyes.datatypes import AgentFrame, Message
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import make_own_protocol
from manyeyes.models import checkpoint, pretrained
from manyeyes.models.detector.codebook import CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.fusion.registry import list_fusion_modules

pytestmark = pytest.mark.slow
DEFAULT_FUSION = COSTR_TINY.fusion
CASES = [
    *((method, "ermvp" if "ermvp" in method else DEFAULT_FUSION) for method in list_strategies()),
    *(("intermediate", fusion) for fusion in list_fusion_modules() if fusion != DEFAULT_FUSION),
]
"""Every strategy with one fusion, and every fusion with one strategy."""
PAYLOADS = {
    "boxes": ("late", DEFAULT_FUSION, "float16"),
    "points": ("early", DEFAULT_FUSION, "float16"),
    "tokens": ("intermediate", DEFAULT_FUSION, "float16"),
    "codes": ("intermediate-temporal", DEFAULT_FUSION, "codebook"),
    "features": ("intermediate", "where2comm/bare", "float16"),
    "clusters": ("intermediate", "ermvp", None),
    "tokens and a request": ("intermediate-where2comm", DEFAULT_FUSION, "float16"),
}
"""Method, fusion and token encoding of each kind of payload."""


@cache
def make_detector(fusion: str, has_codebook: bool = False) -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        config = replace(COSTR_TINY, fusion=fusion, codebook=CodebookConfig(2, 16) if has_codebook else None)
        detector = Detector(config).eval().requires_grad_(False)
        if detector.codebook is not None:
            detector.codebook.centres.normal_()
    return detector


class OneScenario:
    """A drive as a recording of one scenario."""

    scenarios = ("drive",)

    def __init__(self, drive) -> None:
        self.snapshot = lambda scenario, index: drive.snapshot(index)

    def length(self, scenario: str) -> int:
        return 3

    def eval_indices(self, scenario: str) -> range:
        return range(1, 3)

    def agents(self, scenario: str) -> tuple[int, ...]:
        return (0, 1, 2)


@pytest.mark.parametrize(("method", "fusion"), CASES)
def test_reported_bytes_are_those_on_the_bus(method: str, fusion: str, drive, monkeypatch) -> None:
    published: dict[tuple[int, int], list[bytes]] = {}
    plain = Exchange.send

    def record(self: Exchange, frame: AgentFrame, packets: list[bytes], positions: object) -> None:
        published[frame.agent_id, frame.timestamp_ns] = list(packets)
        plain(self, frame, packets, positions)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(Exchange, "send", record)
    detector = make_detector(fusion)
    metrics = MetricAccumulator(method, make_own_protocol(detector))
    on_bus = list[int]()
    for step in replay(OneScenario(drive()), "drive", detector, [method], ReplayConfig(budget_bytes=4096)):
        for frame, sent in zip(step.snapshot.frames, step.sent):
            packets = published[frame.agent_id, frame.timestamp_ns]
            assert sent.packet_sizes == tuple(map(len, packets))
            on_bus += [sum(map(len, packets))] if packets and frame.agent_id != 0 else []
        metrics.add(step)
    volume = metrics.summarize_communication()
    assert volume.num_messages == len(on_bus) == (0 if method.startswith("no-fusion") else 4)
    if on_bus:
        assert volume.bytes_per_message == sum(on_bus) / len(on_bus) > 0
        assert volume.bytes_per_ego_frame == sum(on_bus) / 2


def share_recorded(sender: Agent, frame: AgentFrame) -> tuple[list[bytes], Message | None]:
    """Return the packets of a frame, and the message as its strategy recorded or composed it."""
    seen: list[Message | None] = []
    compose, record = sender.strategy.compose_message, sender.strategy.record_sent

    def keep_composed(*given: object) -> Message | None:
        seen.append(compose(*given))  # pyright: ignore[reportArgumentType]
        return seen[-1]

    def keep_sent(own: PerceptionCache, at: AgentFrame, message: Message) -> None:
        seen.append(message)
        record(own, at, message)

    object.__setattr__(sender.strategy, "compose_message", keep_composed)
    object.__setattr__(sender.strategy, "record_sent", keep_sent)
    return sender.share(frame), seen[-1]


@pytest.mark.parametrize(("method", "fusion"), CASES)
def test_the_receiver_decodes_the_tensors_of_the_sender(method: str, fusion: str, drive) -> None:
    detector = make_detector(fusion)
    sender = Agent(detector, get_strategy(method), "float32", budget_bytes=None)
    packets, made = share_recorded(sender, drive().frame(1, 3))
    if made is None:
        assert packets == [] and method.startswith("no-fusion")
        return
    tables = sender.token_format.tables
    message = wire.assemble(wire.decode_packet(packet, tables) for packet in reversed(packets))
    received, rejection = decode_tokens(ReceivedMessage(message, 1, 1, None), detector, sender.token_format)
    got = received.message
    assert rejection is None and [got.tokens is None, got.objects is None, got.points is None] == [
        made.tokens is None, made.objects is None, made.points is None,
    ]  # fmt: skip
    if made.tokens is not None:
        assert got.tokens is not None and len(made.tokens.sites) > 0
        assert torch.equal(got.tokens.sites.key, made.tokens.sites.key)
        assert torch.equal(got.tokens.features, made.tokens.features)
    if made.points is not None:
        assert got.points is not None
        # Packets deal points out in turn, so that they come in another order.
        rows = [
            sorted(map(tuple, torch.round(xyz.double() * 100).tolist())) for xyz in (got.points.xyz, made.points.xyz)
        ]
        assert rows[0] == rows[1]
    if made.objects is not None:
        assert got.objects is not None and len(made.objects) > 0
        order = made.objects.score.argsort(descending=True, stable=True)
        objects = made.objects[order]
        assert float((got.objects.center[:, :2] - objects.center[:, :2]).abs().max()) <= 0.0051
        assert float((got.objects.score - objects.score).abs().max()) <= 1 / 65_535
        assert float((got.objects.size[:, :2] - objects.size[:, :2]).abs().max()) <= 0.0501


CHILD = """
import pickle, sys, json
from manyeyes.agents.agent import Agent
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.models import pretrained
out = {}
for name, (path, method, encoding, frames, packets) in pickle.load(open(sys.argv[1], "rb")).items():
    ego = Agent(pretrained.load(path), get_strategy(method), encoding)
    for frame, received in zip(frames, packets):
        boxes = ego.perceive(frame, received).boxes
    out[name] = [boxes.center.numpy().tobytes().hex(), boxes.score.numpy().tobytes().hex(), len(boxes)]
print(json.dumps(out))
"""


def test_a_fresh_process_finds_the_same_boxes_in_recorded_bytes(drive, tmp_path: Path) -> None:
    recorded, expected = {}, {}
    for name, (method, fusion, encoding) in PAYLOADS.items():
        detector, path = (
            make_detector(fusion, encoding == "codebook"),
            tmp_path / f"{name.replace(' ', '-')}.safetensors",
        )
        checkpoint.save(detector, path, {})
        make = partial(Agent, pretrained.load(path), token_encoding=encoding)
        ego, others = make(strategy=get_strategy(method)), [make(strategy=get_strategy(method)) for _ in range(2)]
        frames = [drive().frame(0, index) for index in (1, 2, 3)]
        packets = [
            [packet for k, other in enumerate(others) for packet in other.share(drive().frame(k + 1, index))]
            for index in (1, 2, 3)
        ]
        boxes = [ego.perceive(frame, received).boxes for frame, received in zip(frames, packets)][-1]
        assert len(boxes) > 0 and packets[-1]
        recorded[name] = (str(path), method, encoding, frames, packets)
        expected[name] = [boxes.center.numpy().tobytes().hex(), boxes.score.numpy().tobytes().hex(), len(boxes)]
    (tmp_path / "recorded").write_bytes(pickle.dumps(recorded))
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path / "recorded")], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == expected
    assert default_token_encoding(make_detector("ermvp")) == "clusters"
