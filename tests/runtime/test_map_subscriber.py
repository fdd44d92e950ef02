# SPDX-License-Identifier: Apache-2.0
"""Local maps of live agents reach a map server on the same network, and become one map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

pytest.importorskip("cryptography", reason="the extra live is not installed")

from tests.runtime.conftest import START_S, Federation
from tests.runtime.fault_team import MS, PLACE, START_NS, TENTH_NS, AgentClock, FaultTeam, OneCar, frame_of

from manyeyes import Agent, AgentFrame, load_detector
from manyeyes.agents.map_perception import rectangle
from manyeyes.agents.map_server import MapServer
from manyeyes.agents.periodic_map import PeriodicMapPredictor
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.cli.live import map as live_map
from manyeyes.comms.network.interface import Network, Origin, ReceivedPacket
from manyeyes.comms.network.tiles import NetworkTile
from manyeyes.comms.signatures.certificate import SENDER_RIGHTS
from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.map_element import KINDS, MapElements
from manyeyes.datatypes.message import LocalMap
from manyeyes.runtime.authentication import PacketVerifier
from manyeyes.runtime.clock import TAI_UTC_NS, Clock
from manyeyes.runtime.keys import Identity, Issuer, Validity, generate_key, public_bytes
from manyeyes.runtime.map_subscriber import MapSubscriber
from manyeyes.runtime.signing import PacketSigner
from manyeyes.runtime.transports.local import LocalNetwork

DIVIDER = [KINDS.index("divider")]


def predict_line(frame: AgentFrame, received=()) -> LocalMap:
    """A lane divider along x at y = 110 m in the world: agents have no rotation."""
    y = 110.0 - float(frame.world_from_agent.translation[1])
    return LocalMap(MapElements.of([[[0.0, y], [30.0, y]]], DIVIDER, 0.9), rectangle((0.0, -15.0, 30.0, 15.0)))


def make_agent() -> Agent:
    return Agent(OneCar(), get_strategy("late"), map_predictor=PeriodicMapPredictor(predict_line))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["off", "require"])
def test_a_live_run_leaves_a_fused_map(federation: Federation, tmp_path, mode: str) -> None:
    team = FaultTeam(federation, tmp_path, num=3, mode=mode, make_agent=make_agent)
    clock = AgentClock(team)
    network = LocalNetwork(team.bus, 99, clock.true_ns)
    network.join(PLACE)
    network.poll()
    verifier = None if mode == "off" else PacketVerifier(federation.trust, utc_offset_ns=-TAI_UTC_NS)
    subscriber = MapSubscriber(MapServer(origin_xy=PLACE), network, clock, verifier)
    num = 0
    for _ in range(21):
        team.step()
        num += subscriber.poll()
    assert num == len(subscriber.server.observations) == 9 and subscriber.dropped.total == 0
    lines = subscriber.server.rebuild().select_published().elements
    assert len(lines) == 1 and np.allclose(lines.polyline(0)[:, 1], 10.0, atol=0.1)
    # Boxes of a message and its map come in the same packets.
    ticks = team.step()
    assert all(len(tick.perception.received) == 2 for tick in ticks.values())


@pytest.mark.slow
def test_maps_beside_coded_tokens_are_used_without_the_weights_of_the_tokens(drive, federation, tmp_path) -> None:
    frame = replace(drive(1).frame(0, 0), agent_id=1, timestamp_ns=START_NS)
    line = LocalMap(MapElements.of([[[0.0, 0.0], [30.0, 0.0]]], DIVIDER, 0.9), rectangle((0.0, -15.0, 30.0, 15.0)))
    agent = Agent(load_detector(), get_strategy("intermediate"), map_predictor=lambda frame, received=(): line)
    team = FaultTeam(federation, tmp_path, num=2)
    clock = AgentClock(team)
    sender, network = (LocalNetwork(team.bus, k, clock.true_ns) for k in (1, 99))
    subscriber = MapSubscriber(MapServer(), network, clock)
    packets = agent.share(frame)
    sender.send(packets, (0.0, 0.0))
    assert len(packets) > 1 and subscriber.poll() == 1
    assert subscriber.dropped.wrong_model > 0 and len(subscriber.server.observations[0].elements) == 1
    # A message that lacks another packet is not complete.
    later = agent.share(replace(frame, timestamp_ns=START_NS + 10**8))
    team.ns += 10**8
    sender.send(later[:-1], (0.0, 0.0))
    assert subscriber.poll() == 0


LINK = Origin("link")


class Wire:
    """A network whose packets the test puts there. arrived: what the next poll returns."""

    def __init__(self) -> None:
        self.arrived: list[ReceivedPacket] = []

    def put(self, packets: Iterable[bytes], arrival_ns: int, origin: Origin = LINK) -> None:
        self.arrived += [ReceivedPacket(packet, arrival_ns, origin) for packet in packets]

    def poll(self) -> list[ReceivedPacket]:
        arrived, self.arrived = self.arrived, []
        return arrived


class FixedClock:
    def __init__(self, now_ns: int) -> None:
        self.time_ns = now_ns

    def now_ns(self) -> int:
        return self.time_ns


class Receiver:
    """A map server in mode require, and an honest signed sender, agent 1, of a line a frame."""

    def __init__(self, federation: Federation) -> None:
        self.wire, self.clock = Wire(), FixedClock(START_NS)
        verifier = PacketVerifier(federation.trust, utc_offset_ns=-TAI_UTC_NS)
        server = MapServer(origin_xy=PLACE)
        self.subscriber = MapSubscriber(server, cast(Network, self.wire), cast(Clock, self.clock), verifier)
        self.signer = PacketSigner(federation.identity(1))
        self.agent = Agent(OneCar(), get_strategy("late"), map_predictor=predict_line)

    def share(self, number: int) -> list[bytes]:
        """The unsigned packets of a frame."""
        return self.agent.share(frame_of(1, START_NS + number * TENTH_NS))

    def send(self, packets: list[bytes], number: int, origin: Origin = LINK, late_ns: int = MS) -> int:
        """Let packets arrive after a frame; return the number of new observations."""
        self.clock.time_ns = START_NS + number * TENTH_NS + late_ns
        self.wire.put(packets, self.clock.time_ns, origin)
        return self.subscriber.poll()

    def digest(self) -> list[bytes]:
        """The fused map, bit for bit."""
        fused = self.subscriber.server.rebuild()
        return [fused.elements.polyline(row).tobytes() for row in range(len(fused))]


def sign(signer: PacketSigner, packets: list[bytes]) -> list[bytes]:
    return signer.sign(packets, START_NS - TAI_UTC_NS)


def unknown_identity() -> Identity:
    key = generate_key()
    valid = Validity(START_S - 60)
    return Identity(key, Issuer.of_anchor(generate_key()).issue(public_bytes(key), SENDER_RIGHTS, 1, valid))


def hostile_packets(receiver: Receiver, federation: Federation, reason: str) -> list[bytes]:
    """Packets of the sixth frame that are refused for a reason."""
    plain = receiver.share(5)
    signed = sign(receiver.signer, plain)
    other = PacketSigner(federation.identity(2))
    return {
        "oversize": [signed[0] + bytes(100_000)],
        "garbage": [b"", b"ME", bytes(200), signed[0][:40], b"MS"],
        "version": [b"MS" + bytes(300), b"ME" + bytes([99]) + bytes(300)],
        "checksum": [plain[0][:-1] + bytes([plain[0][-1] ^ 1])],
        "unsigned": plain,
        "forged": [one[:-1] + bytes([one[-1] ^ 1]) for one in signed],
        "certificate": sign(PacketSigner(unknown_identity()), plain[:1]),
        "identity": sign(other, plain),
        "expired": sign(receiver.signer, receiver.share(-30)),
        "future": sign(receiver.signer, receiver.share(60)),
    }[reason]


@pytest.mark.parametrize(
    "reason",
    [
        "oversize",
        "garbage",
        "version",
        "checksum",
        "unsigned",
        "forged",
        "certificate",
        "identity",
        "expired",
        "future",
    ],
)
def test_a_hostile_packet_is_refused_by_its_reason_and_changes_no_map(federation: Federation, reason: str) -> None:
    receiver = Receiver(federation)
    for number in range(4):
        assert receiver.send(sign(receiver.signer, receiver.share(number)), number) == 1
    before, dropped = receiver.digest(), receiver.subscriber.dropped
    hostile = hostile_packets(receiver, federation, reason)
    assert dropped.total == 0 and receiver.send(hostile, 5, Origin("outside")) == 0
    counts = {name: count for name, count in vars(receiver.subscriber.dropped).items() if count}
    assert counts == {reason: len(hostile)} and receiver.digest() == before
    # It goes on.
    assert receiver.send(sign(receiver.signer, receiver.share(6)), 6) == 1
    assert len(receiver.subscriber.server.observations) == 5 and receiver.subscriber.server.rejected == ()


def test_replayed_packets_and_those_of_another_tile_change_no_map(federation: Federation) -> None:
    receiver = Receiver(federation)
    tile = NetworkTile.at(*PLACE)
    sent = sign(receiver.signer, receiver.share(0))
    assert receiver.send(sent, 0, Origin("link", tile.name)) == 1
    before = receiver.digest()
    assert receiver.send(sent, 0, Origin("link", tile.name), 2 * MS) == 0
    assert receiver.subscriber.dropped.replayed == len(sent)
    far = NetworkTile.at(PLACE[0] + 5_000.0, PLACE[1]).name
    later = sign(receiver.signer, receiver.share(1))
    assert receiver.send(later, 1, Origin("link", far)) == 0 and receiver.subscriber.dropped.tile == len(later)
    assert receiver.digest() == before and receiver.send(later, 1, Origin("link", tile.name), 2 * MS) == 1


def test_messages_that_waited_in_the_network_are_all_ingested(federation: Federation) -> None:
    """A server that was busy for a second polls ten messages of one sender at once."""
    receiver = Receiver(federation)
    for number in range(10):
        receiver.wire.put(sign(receiver.signer, receiver.share(number)), START_NS + number * TENTH_NS + MS)
    assert receiver.send([], 10) == 10 and receiver.subscriber.server.num_incomplete == 0


def test_what_arrived_while_the_server_was_busy_is_received_after_it_was_stopped(federation, monkeypatch) -> None:
    monkeypatch.setattr(live_map.signal, "signal", lambda *_: None)
    receiver = Receiver(federation)
    receiver.wire.put(sign(receiver.signer, receiver.share(0)), START_NS + MS)
    live_map._receive(receiver.subscriber, 0.0)
    assert len(receiver.subscriber.server.observations) == 1


def test_a_map_is_sent_once_a_period() -> None:
    predictor = PeriodicMapPredictor(predict_line, 300_000_000)
    sent = [predictor(frame_of(1, k * 100_000_000)) is not None for k in range(9)]
    assert sent == [True, False, False] * 3
    with pytest.raises(ConfigError, match="above 0"):
        PeriodicMapPredictor(predict_line, 0)
