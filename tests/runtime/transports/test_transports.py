# SPDX-License-Identifier: Apache-2.0
"""All networks carry the same packets: to all others of the network around, not to their sender, and in bounded buffers."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence

import pytest

from manyeyes.comms.channel import Channel, channel_preset
from manyeyes.comms.local_bus import LocalBus
from manyeyes.comms.network.interface import Network, ReceivedPacket
from manyeyes.comms.network.tiles import TILE_M
from manyeyes.datatypes import ConfigError
from manyeyes.runtime.transports.local import LocalNetwork
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork
from manyeyes.runtime.transports.zenoh import ZenohConfig, ZenohNetwork

HERE, WAIT_S = (100.0, 100.0), 5.0
Join = Callable[..., Network]
KINDS = ("local", "udp", "zenoh")


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def join(request: pytest.FixtureRequest) -> Iterator[Join]:
    """Makes networks of one kind for agents 1, 2, ... on the loopback interface."""
    made: list[Network] = []
    bus, port = LocalBus(Channel(channel_preset("ideal"))), free_port()
    own = f"test-{os.getpid()}"

    def make(name: str = own) -> Network:
        agent_id = len(made) + 1
        if request.param == "local":
            network: Network = LocalNetwork(bus, agent_id, time.time_ns)
        elif request.param == "udp":
            network = UdpNetwork(UdpConfig(name, port=port), time.time_ns)
        else:
            pytest.importorskip("zenoh", reason="the extra live is not installed")
            seed = f"tcp/127.0.0.1:{port}"
            config = ZenohConfig(name, listen=(seed,)) if agent_id == 1 else ZenohConfig(name, connect=(seed,))
            network = ZenohNetwork(config, agent_id, time.time_ns)
        made.append(network)
        return network

    yield make
    for network in made:
        network.close()


def settle(networks: Sequence[Network], positions: Sequence[tuple[float, float]]) -> None:
    """Send until the first receiver has something of each other one that is near: subscriptions take a moment."""
    until = time.monotonic() + WAIT_S
    while time.monotonic() < until:
        for network, position in zip(networks, positions):
            network.send([b"hello"], position)
        time.sleep(0.02)
        if all(network.neighbours() or network.poll() for network in networks[:2]):
            break
    time.sleep(0.1)
    for network in networks:
        network.poll()


def collect(network: Network, count: int, wait_s: float = WAIT_S) -> list[ReceivedPacket]:
    found, until = list[ReceivedPacket](), time.monotonic() + wait_s
    while len(found) < count and time.monotonic() < until:
        found += network.poll()
        time.sleep(0.005)
    return found


@pytest.mark.parametrize("join", KINDS, indirect=True)
def test_packets_reach_the_others_and_not_their_sender(join: Join) -> None:
    a, b = join(), join()
    settle((a, b), (HERE, HERE))
    packets = [bytes([k]) * size for k, size in enumerate((1, 68, 1_398, 1_600))][
        : 3 if isinstance(a, LocalNetwork) else 4
    ]
    before = time.time_ns()
    a.send(packets, HERE)
    got = collect(b, len(packets))
    assert sorted(p.packet for p in got) == sorted(packets)
    assert all(before <= p.arrival_ns <= time.time_ns() for p in got)
    assert len({p.origin.link for p in got}) == 1 and b.neighbours() == {got[0].origin.link}
    assert a.poll() == []


@pytest.mark.parametrize("join", ["udp", "zenoh"], indirect=True)
def test_networks_and_tiles_scope_what_is_received(join: Join) -> None:
    a, near, far, other = join(), join(), join(), join("another")
    places = (HERE, (100.0 + TILE_M, 100.0), (100.0 + 2 * TILE_M, 100.0), HERE)
    settle((a, near, far, other), places)
    a.send([b"here"], HERE)
    assert [(p.packet, p.origin.tile) for p in collect(near, 1)] == [(b"here", "g0_0")]
    assert [p for p in collect(far, 1, 0.2) + other.poll() if p.packet == b"here"] == []
    # An agent that moves receives from the tiles around its new place.
    until = time.monotonic() + WAIT_S
    while time.monotonic() < until and not any(p.packet == b"again" for p in far.poll()):
        far.send([b"moved"], (100.0 + TILE_M, 100.0))
        a.send([b"again"], HERE)
        time.sleep(0.02)
    assert time.monotonic() < until


@pytest.mark.parametrize("join", ["udp", "zenoh"], indirect=True)
def test_what_is_not_polled_is_bounded_and_the_newest_is_kept(join: Join) -> None:
    a, b = join(), join()
    settle((a, b), (HERE, HERE))
    for k in range(400):
        a.send([k.to_bytes(2, "big")], HERE)
        if k % 20 == 0:
            time.sleep(0.002)
    time.sleep(0.3)
    got = [int.from_bytes(p.packet, "big") for p in b.poll()]
    assert len(got) <= 128 and got == sorted(got) and got[-1] > 300


@pytest.mark.parametrize("join", ["zenoh"], indirect=True)
def test_presence_is_asked_of_the_network_and_ids_change(join: Join) -> None:
    a, b = join(), join()
    assert isinstance(a, ZenohNetwork) and isinstance(b, ZenohNetwork)
    settle((a, b), (HERE, HERE))
    assert a.present() == {"2"}
    b.rename(77)
    until = time.monotonic() + WAIT_S
    while a.present() != {"77"} and time.monotonic() < until:
        time.sleep(0.02)
    assert a.present() == {"77"}
    b.send([b"renamed"], HERE)
    assert [p.origin.link for p in collect(a, 1)] == ["77"]


@pytest.mark.parametrize("join", ["zenoh"], indirect=True)
def test_clocks_of_others_are_asked_for(join: Join) -> None:
    """The clock of agent 2 is 0.3 s ahead: within half of the round trip."""
    a, b = join(), join()
    assert isinstance(a, ZenohNetwork) and isinstance(b, ZenohNetwork)
    settle((a, b), (HERE, HERE))
    b._clock = lambda: time.time_ns() + 300_000_000
    until = time.monotonic() + 2 * WAIT_S
    while not (found := a.clock_offsets()) and time.monotonic() < until:
        time.sleep(0.05)
    assert list(found) == ["2"]
    assert abs(found["2"].offset_ns - 300_000_000) <= found["2"].sigma_ns + 1_000_000
    b.rename(77)
    assert b.clock_offsets() == {}


def test_what_cannot_be_used_is_one_error() -> None:
    with pytest.raises(ConfigError, match=r"203\.0\.113\.7"):
        UdpNetwork(UdpConfig(interface="203.0.113.7"), time.time_ns)
    with pytest.raises(ConfigError, match="letters, digits"):
        ZenohNetwork(ZenohConfig("a/b"), 1, time.time_ns)


def test_datagrams_of_others_are_ignored() -> None:
    port = free_port()
    network = UdpNetwork(UdpConfig("x", port=port), time.time_ns)
    try:
        network.send([b"join"], HERE)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for data in (b"", b"MU", b"MU" + bytes(16), bytes(60)):
                stranger.sendto(data, ("127.0.0.1", port))
        assert collect(network, 1, 0.2) == []
    finally:
        network.close()
