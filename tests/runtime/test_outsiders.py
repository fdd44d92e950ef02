# SPDX-License-Identifier: Apache-2.0
"""Senders without a key change no result in mode require, bit for bit: thirteen attacks that unsigned packets once allowed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.agents.test_hostile_packets import forged, hostile_bodies, sealed, token_body
from tests.runtime.conftest import START_S, Federation

from manyeyes import Agent, AgentFrame
from manyeyes.agents.agent import Perception
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.comms.network.interface import Origin
from manyeyes.comms.signatures.certificate import SENDER_RIGHTS, Certificate
from manyeyes.comms.signatures.envelope import join_signed, split_signed
from manyeyes.comms.wire import encode
from manyeyes.datatypes import Boxes, Message, Transform
from manyeyes.runtime.authentication import PacketVerifier
from manyeyes.runtime.keys import Identity, Issuer, Validity, generate_key, public_bytes
from manyeyes.runtime.signing import PacketSigner

NOW, TENTH_NS, INSTANTS = START_S * 10**9, 10**8, 3
EGO, VICTIM = 0, 1


def at(frame: AgentFrame) -> AgentFrame:
    return replace(frame, timestamp_ns=frame.timestamp_ns + NOW)


def boxes(
    agent_id: int, time_ns: int, count: int, xy: tuple[float, float] = (0.0, 0.0), z_m: float = 0.0
) -> list[bytes]:
    """A message with boxes of score 1."""
    centre = torch.tensor([[*xy, 0.8]]).repeat(count, 1)
    found = Boxes.of(centre, torch.tensor([[4.5, 1.9, 1.6]]).repeat(count, 1), torch.zeros(count))
    pose = Transform.from_xyz_yaw(1234.5, -678.9, z_m)
    return encode(Message(agent_id, time_ns, pose, torch.zeros(3, 3), b"testtest", objects=found))


def cells(packet: bytes, count: int) -> bytes:
    """A body of tokens that names each of the first cells."""
    return token_body(packet, np.zeros((count, 1), np.float32))


Attack = Callable[[bytes, int], list[bytes]]
"""Packets at a time (ns), made of an honest packet of the victim."""
ATTACKS: dict[str, Attack] = {
    "1 one channel": lambda p, now: [forged(p, 66, hostile_bodies(p)["one channel"], time_ns=now)],
    "1 features of 3e38": lambda p, now: [forged(p, 66, hostile_bodies(p)["3e38"], time_ns=now)],
    "2 boxes far away": lambda p, now: [p for k in range(10) for p in boxes(70 + k, now, 250, (160.0, 0.0))],
    "3 an empty message of the victim": lambda p, now: [forged(p, VICTIM, b"", 0, now + 1)],
    "4 the same in the future": lambda p, now: [forged(p, VICTIM, b"", 0, now + 999_000_000)],
    "5 sixty-four ids": lambda p, now: [forged(p, 100 + k, b"", 0, now + 999_000_000 * (k % 2)) for k in range(128)],
    "6 a stamp in the future": lambda p, now: [forged(p, 66, time_ns=now + 900_000_000)],
    "7 an hour ago": lambda p, now: [forged(p, VICTIM, time_ns=now - 3_600 * 10**9)],
    "8 a pose in the air": lambda p, now: boxes(66, now, 9, z_m=1e6),
    "8 a stamp of -2**63": lambda p, now: [forged(p, 66, time_ns=-(2**63))],
    "9 a large packet": lambda p, now: [sealed(p[:-4] + bytes(70_000)), forged(p, 66, bytes(60_000), time_ns=now)],
    "10 many cells": lambda p, now: [forged(p, 66, cells(p, 4_000), time_ns=now)],
    "11 many senders of many cells": lambda p, now: [forged(p, 70 + k, cells(p, 900), time_ns=now) for k in range(32)],
    "12 content of the victim": lambda p, now: boxes(VICTIM, now + 30_000_000, 5, (5.0, 5.0)),
    "13 a box on an own box": lambda p, now: boxes(66, now, 1, (3.0, 1.0)),
}


def disguise(packets: list[bytes], signed: bytes, outsider: Identity) -> list[bytes]:
    """Unsigned; with the envelope of the victim, with and without its certificate; and with a certificate of no known issuer."""
    victim = split_signed(signed)
    ticket, wrong = outsider.certificate.pack(), lambda _: victim.signature
    stolen = [join_signed(victim.signer, c, p, wrong) for p in packets for c in (victim.certificate, None)]
    own = [join_signed(outsider.certificate.identifier, ticket, p, outsider.key.sign) for p in packets]
    mixed = [join_signed(victim.signer, victim.certificate, p, outsider.key.sign) for p in packets]
    return [*packets, *stolen, *own, *mixed]


class Scene:
    """An ego and an honest sender that signs. cache: detector outputs of all runs."""

    def __init__(self, detector, drive, federation: Federation, strategy: str) -> None:
        self.detector, self.strategy, self.federation, self.cache = detector, strategy, federation, {}
        some = drive(2)
        self.frames = [at(some.frame(EGO, k)) for k in range(INSTANTS)]
        sender = Agent(detector, get_strategy(strategy), "float16", budget_bytes=4_096)
        signer = PacketSigner(federation.identity(VICTIM))
        self.plain, self.signed = list[list[bytes]](), list[list[bytes]]()
        for k in range(INSTANTS):
            frame = at(some.frame(VICTIM, k))
            packets = sender.share(frame, envelope=signer.envelope(frame.timestamp_ns))
            self.plain.append(packets)
            self.signed.append(signer.sign(packets, frame.timestamp_ns))

    def perceive(self, hostile: list[list[bytes]]) -> list[Perception]:
        """Perceptions of the ego; hostile packets arrive before and after the honest ones of their instant."""
        ego = Agent(
            self.detector,
            get_strategy(self.strategy),
            perception_cache=PerceptionCache(self.detector, feature_cache=self.cache),
        )
        inbox = ego.inbox(authenticator=PacketVerifier(self.federation.trust, "require"))
        found = []
        for frame, bad, good in zip(self.frames, hostile, self.signed):
            links = [*("outside" for _ in bad), *("inside" for _ in good), *("outside" for _ in bad)]
            for packet, link in zip([*bad, *good, *bad], links):
                inbox.push(packet, frame.timestamp_ns, Origin(link))
            found.append(ego.perceive(frame, inbox))
        return found


@pytest.fixture(scope="module")
def scenes(detector, federation: Federation):
    from tests.agents.conftest import Drive

    made = {name: Scene(detector, Drive, federation, name) for name in ("late", "intermediate")}
    return {name: (scene, scene.perceive([[]] * INSTANTS)) for name, scene in made.items()}


@pytest.fixture(scope="module")
def token_packet(detector) -> bytes:
    """A packet of tokens as float32, whose layout the attacks change."""
    from tests.agents.conftest import Drive

    return Agent(detector, token_encoding="float32").share(at(Drive(2).frame(VICTIM, 0)))[0]


@pytest.fixture(scope="module")
def outsider() -> Identity:
    key = generate_key()
    certificate: Certificate = Issuer.of_anchor(generate_key()).issue(
        public_bytes(key), SENDER_RIGHTS, VICTIM, Validity(START_S)
    )
    return Identity(key, certificate)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["late", "intermediate"])
@pytest.mark.parametrize("name", ATTACKS)
def test_an_outsider_changes_nothing_bit_for_bit(scenes, outsider, token_packet, name: str, strategy: str) -> None:
    scene, clean = scenes[strategy]
    hostile = [
        disguise(ATTACKS[name](token_packet, frame.timestamp_ns), signed[0], outsider)
        for frame, signed in zip(scene.frames, scene.signed)
    ]
    # The captured envelope of the first instant carries the certificate.
    hostile[1] += disguise(ATTACKS[name](token_packet, scene.frames[1].timestamp_ns), scene.signed[0][0], outsider)
    struck = scene.perceive(hostile)
    for one, other in zip(clean, struck):
        assert torch.equal(one.boxes.bev(), other.boxes.bev()) and torch.equal(one.boxes.score, other.boxes.score)
        assert [m.message.agent_id for m in other.received] == [VICTIM] and other.rejected == ()
        assert one.received[0].received_packets == other.received[0].received_packets


@pytest.mark.slow
def test_the_same_attack_by_an_unsigned_sender_changes_results_without_keys(scenes) -> None:
    """The attacks are real: without authentication, content in the name of the victim replaces its message."""
    scene, _ = scenes["late"]
    frame = scene.frames[0]
    ego = Agent(scene.detector, get_strategy("late"))
    hostile = ATTACKS["12 content of the victim"](scene.plain[0][0], frame.timestamp_ns)
    found = [ego.perceive(frame, packets) for packets in (scene.plain[0], [*scene.plain[0], *hostile])]
    assert [len(p.received[0].message.objects) for p in found] != [5, 5] and len(
        found[1].received[0].message.objects
    ) == 5


@pytest.mark.slow
@pytest.mark.parametrize("budget", [700, 1_500, 4_096])
@pytest.mark.parametrize("encoding", ["float16", "float32"])
def test_a_byte_budget_holds_signatures_and_certificate(detector, drive, federation, budget: int, encoding) -> None:
    frame = at(drive(2).frame(VICTIM, 0))
    signer = PacketSigner(federation.identity(VICTIM))
    for tenth in range(2):
        now = replace(frame, timestamp_ns=frame.timestamp_ns + tenth * TENTH_NS)
        packets = Agent(detector, token_encoding=encoding).share(
            now, budget, envelope=signer.envelope(now.timestamp_ns)
        )
        sent = signer.sign(packets, now.timestamp_ns)
        assert packets and sum(map(len, sent)) <= budget and max(map(len, sent)) <= 1_398
        plain = Agent(detector, token_encoding=encoding).share(now, budget)
        added = 76 * len(packets) + (126 if tenth == 0 else 0)
        assert sum(map(len, sent)) == sum(map(len, packets)) + added and sum(map(len, plain)) >= sum(map(len, packets))
