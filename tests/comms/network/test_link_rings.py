# SPDX-License-Identifier: Apache-2.0
"""Buffers of links are bounded, keep the newest packets, and let no link delay another."""

from __future__ import annotations

from manyeyes.comms.network.interface import Origin
from manyeyes.comms.network.link_rings import MAX_PACKET_BYTES, NEIGHBOUR_SILENCE_NS, LinkRings


class Clock:
    ns = 10**18

    def __call__(self) -> int:
        return self.ns


def put(rings: LinkRings, link: str, *packets: bytes) -> None:
    for packet in packets:
        rings.put(packet, Origin(link))


def test_the_newest_packets_of_a_link_are_kept() -> None:
    rings = LinkRings(Clock(), ring_packets=3)
    put(rings, "a", b"1", b"2", b"3", b"4", b"5")
    assert [p.packet for p in rings.take()] == [b"3", b"4", b"5"] and rings.overflows == 2
    assert rings.take() == []


def test_links_take_turns_and_each_is_in_order() -> None:
    rings = LinkRings(Clock())
    put(rings, "flood", *(bytes([k]) for k in range(50)))
    put(rings, "b", b"x", b"y")
    assert [p.packet for p in rings.take()][:4] == [b"\x00", b"x", b"\x01", b"y"]


def test_new_links_take_the_place_of_silent_ones_only() -> None:
    clock = Clock()
    rings = LinkRings(clock, max_links=2)
    put(rings, "a", b"1")
    put(rings, "b", b"1")
    put(rings, "c", b"1")
    assert rings.overflows == 1 and rings.links() == {"a", "b"}
    clock.ns += NEIGHBOUR_SILENCE_NS + 1
    put(rings, "b", b"2")
    put(rings, "c", b"2")
    assert rings.links() == {"b", "c"} and [p.packet for p in rings.take()] == [b"1", b"2", b"2"]


def test_long_packets_are_not_stored_and_arrivals_are_of_the_clock() -> None:
    clock = Clock()
    rings = LinkRings(clock)
    put(rings, "a", bytes(MAX_PACKET_BYTES + 1), b"1")
    (packet,) = rings.take()
    assert packet.arrival_ns == clock.ns and rings.overflows == 1
