# SPDX-License-Identifier: Apache-2.0
"""A known link of UDP multicast keeps its packets in a flood, and none is lost or comes twice when it gets its own socket."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest
from tests.runtime.transports.test_transports import HERE, free_port

from manyeyes.runtime.transports.link_sockets import (
    HAS_LINK_SOCKETS,
    MAX_LINK_RATE,
    MAX_SILENCE_S,
    OBSERVED_S,
    REFUSED_S,
    LinkSockets,
    ReadBudget,
)
from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork

needs_link_sockets = pytest.mark.skipif(not HAS_LINK_SOCKETS, reason="links have sockets of their own on Linux only")
SENDER = ("127.0.0.1", 4_000, "239.1.2.3")


@pytest.fixture
def pair() -> Iterator[tuple[UdpNetwork, UdpNetwork]]:
    port = free_port()
    networks = UdpNetwork(UdpConfig("x", port=port), time.time_ns), UdpNetwork(UdpConfig("x", port=port), time.time_ns)
    for network in networks:
        network.join(HERE)
    yield networks
    for network in networks:
        network.close()


def send_for(network: UdpNetwork, other: UdpNetwork, seconds: float, first: int = 0) -> tuple[int, list[int]]:
    """Send 100 numbered packets a second; return the next number, and the numbers that the other received."""
    number, got, until_s = first, list[int](), time.monotonic() + seconds
    while time.monotonic() < until_s:
        network.send([number.to_bytes(8, "big")], HERE)
        number += 1
        time.sleep(0.01)
        got += [int.from_bytes(p.packet, "big") for p in other.poll() if len(p.packet) == 8]
    time.sleep(0.2)
    return number, got + [int.from_bytes(p.packet, "big") for p in other.poll() if len(p.packet) == 8]


@needs_link_sockets
def test_no_packet_is_lost_or_doubled_when_a_link_gets_its_socket(pair):
    a, b = pair
    number, got = send_for(a, b, 3 * OBSERVED_S)
    assert len(b._links) == 1
    assert got == list(range(number))


@needs_link_sockets
def test_a_flood_loses_no_packet_of_a_known_link_and_is_not_read_whole(pair):
    a, b = pair
    number, _ = send_for(a, b, 2 * OBSERVED_S)
    assert len(b._links) == 1
    sent, is_over = [0], threading.Event()

    def flood() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            tile = a._move(HERE)
            data = b"MU" + a._scope(tile) + tile.i.to_bytes(4, "little") + tile.j.to_bytes(4, "little") + bytes(1_200)
            while not is_over.is_set():
                for _ in range(50):
                    stranger.sendto(data, (a._group(tile), a._config.port))
                sent[0] += 50
                time.sleep(0.002)

    thread, before, began_s = threading.Thread(target=flood), b.overflows, time.monotonic()
    thread.start()
    after, got = number, list[int]()
    while sent[0] < 10_000 and time.monotonic() < began_s + 20.0:
        after, more = send_for(a, b, 0.5, after)
        got += more
    is_over.set()
    thread.join()
    seconds = time.monotonic() - began_s
    assert got == list(range(number, after))
    assert len(b._links) == 1
    # The flood sends more than the budget; what is read of it is bounded, and most of that gives way in its ring.
    assert sent[0] >= 10_000 and b.overflows - before <= 500 + 2_100 * seconds


@needs_link_sockets
def test_sockets_are_for_links_of_a_moderate_rate_that_speak():
    now = [0.0]
    links = LinkSockets(free_port(), lambda: now[0])
    fast, slow = SENDER, ("127.0.0.1", 4_001, "239.1.2.3")
    ready = {fast: False, slow: False}
    for _ in range(60):
        ready[slow] |= links.observe(slow)
        for _ in range(round(MAX_LINK_RATE * 0.02)):
            ready[fast] |= links.observe(fast)
        now[0] += 0.01
    assert ready == {fast: False, slow: True}
    assert links.open(slow) is not None and slow in links and list(links.receivers()) == [slow]
    for _ in range(round(2 * MAX_LINK_RATE)):
        now[0] += 0.4 / MAX_LINK_RATE
        if slow in links:
            links.count(slow)
    assert slow not in links and not any(links.observe(slow) for _ in range(3))
    now[0] += REFUSED_S + OBSERVED_S
    links.close_silent()
    assert links.observe(slow) and links.open(slow) is not None
    now[0] += MAX_SILENCE_S + 0.1
    links.close_silent()
    assert len(links) == 0
    assert links.open(("127.0.0.1", 4_002, "999.1.2.3")) is None
    links.close()


def test_senders_that_are_observed_are_bounded():
    links = LinkSockets(free_port(), lambda: 0.0)
    for port in range(2_000):
        assert not links.observe(("127.0.0.1", port, "239.1.2.3"))
    assert len(links._observed) == 256


def test_a_budget_refills_at_its_rate():
    now = [0.0]
    budget = ReadBudget(10.0, 5.0, lambda: now[0])
    assert sum(budget.take() for _ in range(9)) == 5
    now[0] = 0.2
    assert sum(budget.take() for _ in range(9)) == 2
    now[0] = 60.0
    assert sum(budget.take() for _ in range(9)) == 5
