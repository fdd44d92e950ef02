# SPDX-License-Identifier: Apache-2.0
"""Mutated packets with repaired checksums through perceive, hundreds in one call, with honest senders beside them.

No exception, the receptions of the honest senders are those of a receiver without the mutated packets, and memory is bounded.
``make probes`` sends a million packets: ``python -m tests.probes.test_packets PACKETS`` prints what came of them.
Resident memory there grows by kernels that oneDNN keeps (``test_soak``), unless ONEDNN_PRIMITIVE_CACHE_CAPACITY is small.
"""

from __future__ import annotations

import struct
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from tests.agents.conftest import Drive, tiny_detector
from tests.probes.hostile import extremes, mutate, seal
from tests.probes.memory import release_memory, resident_kb

from manyeyes import Agent, AgentFrame, Message
from manyeyes.agents.map_perception import encode_map_message
from manyeyes.agents.pose_correction import PoseCorrection
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datatypes.map_element import MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.models.detector.detector import Detector

HONEST_IDS = (1001, 1002)
FRAMES = 4
"""Frames of one receiver; then another one begins. In the first one there are no mutated packets."""
MAX_GROWTH_KB = 64 << 10


@dataclass
class Counts:
    """What came of the packets of one strategy: rejections by reason, and how many senders were fused."""

    packets: int = 0
    calls: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


def honest_frames(index: int) -> list[AgentFrame]:
    """The ego's frame, and those of two honest senders."""
    ego, *others = Drive().frames(index)
    return [ego, *(replace(frame, agent_id=agent_id) for frame, agent_id in zip(others, HONEST_IDS))]


def specimens(detector: Detector, frame: AgentFrame) -> list[bytes]:
    """Packets of all kinds of bodies and all encodings, from one sender."""
    found: list[bytes] = []
    for encoding in ("float32", "float16", "int8"):
        found += Agent(
            detector, token_encoding=encoding, budget_bytes=6000, send_request_map=True, send_sight=True
        ).share(frame)
    found += Agent(detector, get_strategy("late")).share(frame)
    found += Agent(detector, get_strategy("early")).share(frame)[:2]
    lines = [np.array([[2.0, -3.0], [9.0, -2.5], [20.0, 1.0]]), np.array([[5.0, 5.0], [8.0, 5.0], [8.0, 8.0]])]
    view = np.array([[0.0, -15.0], [30.0, -15.0], [30.0, 15.0], [0.0, 15.0]])
    elements = MapElements.of(lines, np.array([0, 3]), np.array([0.9, 0.4]), 0.1)
    return found + encode_map_message(frame, LocalMap(elements, view), detector.fingerprint)


def readdress(packet: bytes, agent_id: int) -> bytes:
    """Return a packet as of another sender: ids are not authenticated, so a forged one is that sender."""
    return seal(packet[:8] + struct.pack("<i", agent_id) + packet[12:-4])


def equal(a: Message, b: Message) -> bool:
    """Return whether two messages hold the same."""
    if (a.tokens is None) != (b.tokens is None) or (a.objects is None) != (b.objects is None):
        return False
    same = a.timestamp_ns == b.timestamp_ns
    same &= torch.equal(a.world_from_agent.matrix(), b.world_from_agent.matrix())
    if a.tokens is not None and b.tokens is not None:
        same &= torch.equal(a.tokens.sites.key, b.tokens.sites.key)
        same &= torch.equal(a.tokens.features, b.tokens.features)
    if a.objects is not None and b.objects is not None:
        same &= torch.equal(a.objects.bev(), b.objects.bev()) and torch.equal(a.objects.score, b.objects.score)
    return same


@dataclass(frozen=True)
class Specimens:
    """What is mutated at one instant: packets of all kinds, and each of them with each field at each extreme."""

    packets: list[bytes]
    extremes: list[bytes]

    @classmethod
    def of(cls, detector: Detector, index: int) -> Specimens:
        packets = specimens(detector, honest_frames(index)[1])
        return cls(packets, [changed for packet in packets for _, changed in extremes(packet)])

    def draw(self, count: int, random: np.random.Generator) -> list[bytes]:
        """Return packets of up to 38 senders; one of four has a field at an extreme."""
        found = []
        for _ in range(count):
            if random.random() < 0.25:
                packet = self.extremes[int(random.integers(len(self.extremes)))]
            else:
                packet = mutate(self.packets, random)
            found.append(readdress(packet, int(random.integers(2, 40))))
        return found


@dataclass
class Probe:
    """Receivers of one strategy with and without mutated packets, on one drive. specimens: of each frame after the first."""

    detector: Detector
    strategy: str
    specimens: Sequence[Specimens]
    per_call: int
    random: np.random.Generator
    counts: Counts = field(default_factory=Counts)

    def run(self, packets: int) -> Counts:
        """Send at least so many mutated packets."""
        while self.counts.packets < packets:
            self.receive_drive()
        return self.counts

    def receive_drive(self) -> None:
        """Perceive a drive with and without mutated packets, and compare the honest senders' messages."""
        struck, clean = (Agent(self.detector, get_strategy(self.strategy)) for _ in range(2))
        forged = Agent(self.detector, get_strategy(self.strategy), pose_correction=PoseCorrection())
        senders = [Agent(self.detector, get_strategy(self.strategy), budget_bytes=6000) for _ in HONEST_IDS]
        for index in range(len(self.specimens) + 1):
            ego, *others = honest_frames(index)
            honest = [packet for agent, frame in zip(senders, others) for packet in agent.share(frame)]
            # The honest senders are known before the first mutated packet comes.
            bad = self.specimens[index - 1].draw(self.per_call, self.random) if index else []
            wanted = clean.perceive(ego, honest)
            perception = struck.perceive(ego, [*bad[::2], *honest, *bad[1::2]])
            self.compare(perception.received, wanted.received)
            self.counts.reasons.update(rejection.reason for rejection in perception.rejected)
            self.counts.reasons["fused"] += len(perception.received) - len(wanted.received)
            # Half of these carry an honest id: nothing is to be compared, but nothing raises.
            ids = self.random.integers(0, 2, len(bad)).tolist()
            forged.perceive(ego, [*honest, *(readdress(p, HONEST_IDS[0]) if i else p for p, i in zip(bad, ids))])
            self.counts.packets += 2 * len(bad)
            self.counts.calls += 2 if bad else 0

    def compare(self, received: Sequence, wanted: Sequence) -> None:
        """Check that the honest senders' receptions are the same."""
        found = {r.message.agent_id: r for r in received}
        for reception in wanted:
            agent_id = reception.message.agent_id
            assert agent_id in found, f"{self.strategy}: honest sender {agent_id} is not fused"
            assert found[agent_id].received_packets == reception.received_packets
            assert equal(found[agent_id].message, reception.message), f"{self.strategy}: another message of {agent_id}"


@pytest.fixture(scope="module")
def tiny() -> Detector:
    return tiny_detector()


@pytest.fixture(scope="module")
def mutable(tiny: Detector, is_long: bool) -> list[Specimens]:
    return [Specimens.of(tiny, index) for index in range(1, FRAMES if is_long else 2)]


@pytest.mark.slow
@pytest.mark.parametrize("strategy", list_strategies())
def test_mutated_packets_change_no_honest_reception(
    tiny: Detector, mutable: list[Specimens], strategy: str, is_long: bool
) -> None:
    random = np.random.default_rng(list_strategies().index(strategy))
    per_call = 400 if is_long else 100
    probe = Probe(tiny, strategy, mutable, per_call, random)
    # The first drive fills the caches that stay.
    probe.receive_drive()
    release_memory()
    before = resident_kb()
    counts = probe.run(1_000_000 // len(list_strategies()) if is_long else 4 * per_call)
    release_memory()
    assert resident_kb() - before < MAX_GROWTH_KB
    assert counts.reasons["fused"] and sum(counts.reasons.values()) > counts.reasons["fused"]
    assert counts.packets == per_call * counts.calls > 2 * per_call


def main() -> None:
    """Print the counts of each strategy, and the growth of resident memory."""
    torch.set_num_threads(1)
    detector, packets = tiny_detector(), int(sys.argv[1])
    instants = [Specimens.of(detector, index) for index in range(1, FRAMES)]
    names = list_strategies()
    probes = [Probe(detector, name, instants, 400, np.random.default_rng(n)) for n, name in enumerate(names)]
    for probe in probes:
        probe.receive_drive()
    release_memory()
    before, began = resident_kb(), time.process_time()
    while sum(probe.counts.packets for probe in probes) < packets:
        for probe in probes:
            probe.receive_drive()
            total = sum(p.counts.packets for p in probes)
            growth = resident_kb() - before
            print(total, probe.strategy, f"+{growth} kB", f"{time.process_time() - began:.0f} s", flush=True)
    for probe in probes:
        print(probe.strategy, probe.counts)


if __name__ == "__main__":
    main()
