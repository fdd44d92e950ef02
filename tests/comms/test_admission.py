# SPDX-License-Identifier: Apache-2.0
"""Admission of packets: each reason is reached by a packet that no other check refuses, and each bound is exact."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import get_args

import numpy as np
import pytest
import torch

from manyeyes.comms import payloads
from manyeyes.comms.drop_counts import AuthenticationRefusal, DropCounts
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.network.interface import UNKNOWN_ORIGIN, Origin
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.token_format import TokenFormat
from manyeyes.comms.wire import HEADER_BYTES, EncodedBody, encode, make_packets
from manyeyes.datatypes import BevGrid, Boxes, Message, PointCloud, Sites, SparseBev, Transform
from manyeyes.datatypes.map_element import MapElements, Polygons
from manyeyes.datatypes.message import LocalMap

torch.set_num_threads(1)
GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)
NOW, TENTH_NS, MS = 10**18, 10**8, 10**6
MODEL = b"model-01"
FORMAT = TokenFormat(MODEL, GRID, 4)
LIMITS = ReceiverLimits()
FIELDS = {"agent": (8, "<i"), "stamp": (12, "<q")}


def header(agent: int = 1, stamp: int = NOW) -> Message:
    """A message without sections."""
    return Message(agent, stamp, Transform.from_xyz_yaw(1.0, 2.0), torch.eye(3, dtype=torch.float64), MODEL)


def tokens(cells: int = 3, channels: int = 4, value: float = 1.0, grid: BevGrid = GRID) -> SparseBev:
    return SparseBev(torch.full((cells, channels), value), Sites(torch.arange(cells), grid))


def boxes(count: int, x_m: float = 0.0) -> Boxes:
    centre = torch.zeros(count, 3)
    centre[:, 0] = x_m
    return Boxes.of(centre, torch.ones(count, 3), torch.zeros(count))


def local_map(count: int, x_m: float = 10.0) -> LocalMap:
    lines = [np.array([[0.0, i % 300 / 10], [x_m, i % 300 / 10]]) for i in range(count)]
    elements = MapElements.of(
        lines, np.zeros(count, np.int64), np.ones(count), np.full(2 * count, 0.1), np.full((count, 4), 0.25)
    )
    return LocalMap(elements, np.array([[-9.0, -9], [9, -9], [9, 9]]), Polygons.of([]))


def changed(packet: bytes, at: int, data: bytes) -> bytes:
    """The packet with other bytes at a place, and the checksum made right."""
    body = packet[:at] + data + packet[at + len(data) : -4]
    return body + struct.pack("<I", zlib.crc32(body))


def empty(agent: int = 1, stamp: int = NOW) -> bytes:
    """A packet without a section, 68 bytes."""
    return encode(header(agent, stamp))[0]


def filled(packets: list[bytes], arrival_ns: int | None = NOW, origin: Origin = UNKNOWN_ORIGIN, **options) -> Inbox:
    inbox = Inbox(**options)
    for packet in packets:
        inbox.push(packet, arrival_ns, origin)
    return inbox


class Refusal:
    """An authenticator that refuses everything for one reason, and keeps the numbers of the packets."""

    def __init__(self, reason: AuthenticationRefusal) -> None:
        self.reason: AuthenticationRefusal = reason
        self.numbers: list[int] = []

    def check(self, envelope, signed, arrival_ns, origin) -> AuthenticationRefusal | None:
        self.numbers.append(envelope.number)
        return self.reason


def packets_of(message: Message, mtu: int = 400) -> list[bytes]:
    return encode(message, token_encoding="float32", mtu=mtu)


def with_objects(count: int = 2, agent: int = 1, stamp: int = NOW, x_m: float = 0.0) -> list[bytes]:
    return packets_of(replace(header(agent, stamp), objects=boxes(count, x_m)))


def with_tokens(**options) -> list[bytes]:
    return packets_of(replace(header(), tokens=tokens(**options)))


def coded_claim(count: int) -> bytes:
    """A packet of tokens that claims so many cells and holds none of them."""
    body = with_tokens()[0][64:79] + struct.pack("<BHH", 0, 4, count)
    return make_packets(header(), [EncodedBody(payloads.TOKENS, body)])[0]


CASES: dict[str, Callable[[], Inbox]] = {
    "oversize": lambda: filled(with_objects(3), limits=replace(LIMITS, max_packet_bytes=68)),
    "garbage": lambda: filled([b"ME\x02" + bytes(20)]),
    "version": lambda: filled([b"ME\x05" + bytes(90)]),
    "checksum": lambda: filled([empty()[:-1] + b"\0"]),
    "implausible": lambda: filled([changed(empty(), 20, b"\0\0\0\0\0\x80")]),
    "future": lambda: filled([empty(stamp=NOW + LIMITS.max_skew_ns + 1)]),
    "expired": lambda: filled([empty(stamp=NOW - LIMITS.max_age_ns - 1)]),
    "tile": lambda: filled([empty()], origin=Origin(tile="g2_0")),
    **{reason: partial(filled, [empty()], authenticator=Refusal(reason)) for reason in get_args(AuthenticationRefusal)},
    "rate": lambda: filled([empty(), *with_objects()], limits=replace(LIMITS, max_instant_packets=1)),
    "wrong_model": lambda: filled([changed(with_tokens()[0], 56, b"model-02")], token_format=FORMAT),
    "grid": lambda: filled(with_tokens(grid=replace(GRID, stride=4)), token_format=FORMAT),
    "width": lambda: filled(with_tokens(channels=5), token_format=FORMAT),
    "value": lambda: filled(with_tokens(value=33.0), token_format=FORMAT),
    "cells": lambda: filled([coded_claim(LIMITS.max_cells + 1)]),
    "objects": lambda: filled(with_objects(3), limits=replace(LIMITS, max_objects=2)),
    "points": lambda: filled(
        packets_of(replace(header(), points=PointCloud.of(torch.zeros(9, 3)))), limits=replace(LIMITS, max_points=8)
    ),
    "map_elements": lambda: filled(
        packets_of(replace(header(), local_map=local_map(3))), limits=replace(LIMITS, max_map_elements=2)
    ),
    "range": lambda: filled(with_objects(2, x_m=300.01)),
    "empty": lambda: filled([*with_objects(), empty(stamp=NOW + 1)]),
    "superseded": lambda: filled([*with_objects(), *with_objects(stamp=NOW - LIMITS.min_stamp_spacing_ns)]),
    "message_size": lambda: filled([changed(empty(), 6, struct.pack("<H", LIMITS.max_message_packets + 1))]),
    "duplicate": lambda: filled([empty(), empty()]),
    "contradiction": lambda: filled([empty(), changed(empty(), 20, b"\1")]),
    "full": lambda: filled(
        [empty(agent, NOW + k * TENTH_NS) for k in range(3) for agent in range(4)] + [empty(9)],
        limits=replace(LIMITS, max_senders=4),
        arrival_ns=None,
    ),
}


def test_every_reason_has_a_case() -> None:
    assert set(CASES) == {f.name for f in fields(DropCounts)}


@pytest.mark.parametrize("reason", CASES)
def test_a_packet_is_refused_by_this_reason_and_no_other(reason: str) -> None:
    assert CASES[reason]().dropped == DropCounts(**{reason: 1})


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        (lambda: filled([empty(stamp=NOW + LIMITS.max_skew_ns)]), "future"),
        (lambda: filled([empty(stamp=NOW - LIMITS.max_age_ns)]), "expired"),
        (lambda: filled([empty()], limits=replace(LIMITS, max_packet_bytes=HEADER_BYTES)), "oversize"),
        (lambda: filled(with_objects(2), limits=replace(LIMITS, max_objects=2)), "objects"),
        (lambda: filled(with_objects(2, x_m=300.0)), "range"),
        (lambda: filled([empty(), *with_objects(agent=2)], limits=replace(LIMITS, max_instant_packets=1)), "rate"),
        (lambda: filled([changed(empty(), 6, struct.pack("<H", LIMITS.max_message_packets))]), "message_size"),
        (lambda: filled([*with_objects(), empty(stamp=NOW + TENTH_NS * 6)], arrival_ns=None), "empty"),
        (lambda: filled(with_tokens(value=32.0), token_format=FORMAT), "value"),
    ],
)
def test_a_bound_itself_is_accepted(inside: Callable[[], Inbox], outside: str) -> None:
    assert inside().dropped == DropCounts(), outside


def test_a_map_line_beyond_the_range_is_refused() -> None:
    limits = replace(LIMITS, max_range_m=50.0)
    assert filled(packets_of(replace(header(), local_map=local_map(1, 50.0))), limits=limits).dropped == DropCounts()
    far = filled(packets_of(replace(header(), local_map=local_map(1, 50.02))), limits=limits)
    assert far.dropped == DropCounts(range=1)


def test_a_grid_beyond_the_range_is_refused_without_a_token_format() -> None:
    inbox = filled(with_tokens(), limits=replace(LIMITS, max_range_m=140.0))
    assert inbox.dropped == DropCounts(range=1) and inbox.messages()[:1] == ()


def test_the_length_of_a_packet_is_checked_before_it_is_copied() -> None:
    """200 MB were accepted, with 2.3 GB of memory."""
    packet, inbox = bytearray(8 << 20), Inbox()
    packet[:3] = b"ME\x02"
    tracemalloc.start()
    inbox.push(memoryview(packet))  # pyright: ignore[reportArgumentType]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 16
    assert inbox.dropped == DropCounts(oversize=1)


def test_nothing_is_allocated_for_cells_that_are_only_claimed() -> None:
    packet, inbox = coded_claim(4096), Inbox()
    tracemalloc.start()
    inbox.push(packet)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 14
    assert inbox.dropped == DropCounts(garbage=1)


@pytest.mark.parametrize("stamp", [-(2**63), 2**63 - 1])
@pytest.mark.parametrize("now", [-(2**63), 0, NOW, 2**63 - 1])
def test_extreme_stamps_are_compared_without_overflow(stamp: int, now: int) -> None:
    inbox = filled([changed(empty(), 12, struct.pack("<q", stamp))], arrival_ns=now)
    expected = DropCounts() if stamp == now else DropCounts(future=1) if stamp > now else DropCounts(expired=1)
    assert inbox.dropped == expected
    without = filled([changed(empty(), 12, struct.pack("<q", stamp))], arrival_ns=None)
    assert len(without.messages(now)) == (stamp == now)


def test_a_packet_that_is_refused_uses_nothing_of_the_bounds() -> None:
    """Contradicting packets do not fill up the message of a victim."""
    first, *rest = packets_of(replace(header(), tokens=tokens(60)))
    inbox = filled(
        [first, *[changed(first, 100, bytes([k])) for k in range(50)], *rest], limits=replace(LIMITS, max_cells=60)
    )
    assert inbox.dropped.contradiction == 50 and inbox.dropped.total == 50
    assert inbox.received_messages()[0].complete


def test_an_authentic_packet_alone_changes_state() -> None:
    refusal = Refusal("forged")
    inbox = filled([*with_objects(), empty()], authenticator=refusal)
    assert refusal.numbers == [0, 0] and inbox.messages() == ()


def stamps(inbox: Inbox) -> list[tuple[int, int]]:
    """Sender and time of each message that is given, relative to NOW in ms."""
    return [(m.agent_id, (m.timestamp_ns - NOW) // MS) for m in inbox.messages()]


@pytest.mark.parametrize("later_ns", [1, LIMITS.min_stamp_spacing_ns, LIMITS.max_skew_ns])
def test_an_empty_packet_does_not_remove_the_message_of_its_id(later_ns: int) -> None:
    """68 bytes with a stamp 1 ns later replaced the whole message."""
    inbox = filled([*with_objects(3), empty(stamp=NOW + later_ns)])
    assert stamps(inbox) == [(1, 0)] and inbox.messages()[0].objects is not None
    for packet in with_objects(2, stamp=NOW + TENTH_NS):
        inbox.push(packet, NOW + TENTH_NS)
    assert stamps(inbox) == [(1, 100)]
    assert inbox.dropped == DropCounts(empty=1)


@pytest.mark.parametrize("offset_ns", [-1, 1])
@pytest.mark.parametrize("is_first", [True, False])
def test_of_messages_of_one_instant_the_longest_is_given(offset_ns: int, is_first: bool) -> None:
    """A stamp 1 ns before or after a sender's own neither replaces its message nor blocks it."""
    own, other = with_objects(9), with_objects(1, stamp=NOW + offset_ns)
    inbox = filled([*other, *own] if is_first else [*own, *other])
    (message,) = inbox.messages()
    assert (message.timestamp_ns, len(message.objects or ())) == (NOW, 9)
    assert inbox.dropped == DropCounts()


def test_a_third_message_of_one_instant_replaces_a_shorter_one_only() -> None:
    inbox = filled([*with_objects(9), *with_objects(3, stamp=NOW + 1), *with_objects(3, stamp=NOW + 2)])
    assert inbox.dropped == DropCounts(superseded=1)
    for packet in with_objects(12, stamp=NOW + 3):
        inbox.push(packet)
    assert inbox.messages()[0].timestamp_ns == NOW + 3
    assert inbox.dropped == DropCounts(superseded=1)


def test_of_equally_long_messages_of_one_instant_the_newest_is_given() -> None:
    for first, second in ((0, 1), (1, 0)):
        inbox = filled([*with_objects(2, stamp=NOW + first), *with_objects(2, stamp=NOW + second)])
        assert inbox.messages()[0].timestamp_ns == NOW + 1


def test_a_stamp_in_the_future_does_not_block_an_id() -> None:
    """At +0.999 s the victim's own packets counted as expired."""
    inbox = filled([*with_objects(stamp=NOW + 999 * MS), *with_objects(2)])
    assert stamps(inbox) == [(1, 0)] and inbox.dropped == DropCounts(future=1)


def test_without_arrival_times_a_stamp_in_the_future_is_not_given() -> None:
    inbox = filled(
        [*with_objects(agent=1), *with_objects(agent=2, stamp=NOW + LIMITS.max_skew_ns + 1)], arrival_ns=None
    )
    assert [m.agent_id for m in inbox.messages(NOW)] == [1]
    inbox = filled(with_objects(stamp=NOW + LIMITS.max_skew_ns), arrival_ns=None)
    assert len(inbox.messages(NOW)) == 1


@pytest.mark.parametrize(
    ("age_ns", "given"), [(-LIMITS.max_skew_ns, 1), (LIMITS.max_age_ns, 1), (LIMITS.max_age_ns + 1, 0)]
)
def test_a_message_is_given_up_to_its_maximum_age(age_ns: int, given: int) -> None:
    inbox = filled(with_objects(), arrival_ns=None)
    assert len(inbox.messages(NOW + age_ns)) == given
    assert len(inbox.messages()) == given


def drive(inbox: Inbox, agents: range, start: int, stop: int, skew_ns: int = 0) -> None:
    """Messages of agents every 100 ms."""
    for k in range(start, stop):
        for agent in agents:
            for packet in with_objects(agent=agent, stamp=NOW + k * TENTH_NS + skew_ns):
                inbox.push(packet, NOW + k * TENTH_NS)


def test_invented_ids_do_not_evict_senders_that_are_received_regularly() -> None:
    """64 ids at +0.999 s evicted every honest sender."""
    inbox, honest = Inbox(), range(1, 4)
    drive(inbox, honest, 0, 3)
    for skew_ns in (999 * MS, LIMITS.max_skew_ns, 0):
        drive(inbox, range(100, 400), 3, 4, skew_ns)
    assert {m.agent_id for m in inbox.messages()} >= set(honest)
    drive(inbox, honest, 3, 4)
    assert stamps(inbox)[:3] == [(agent, 300) for agent in honest]


def test_a_new_sender_gets_a_place_among_invented_ids_and_keeps_it() -> None:
    """64 ids that come first do not keep out an honest sender that comes later."""
    inbox = Inbox()
    drive(inbox, range(100, 200), 0, 1)
    for k in range(4):
        drive(inbox, range(1, 2), k, k + 1)
        drive(inbox, range(200 + 10 * k, 210 + 10 * k), k, k + 1)
    drive(inbox, range(300, 400), 4, 5)
    assert 1 in {m.agent_id for m in inbox.messages()}
    assert len(inbox.messages()) == LIMITS.max_senders


def test_the_first_senders_keep_their_places_and_the_last_give_way_in_order() -> None:
    """Ties are broken by the order of admission: places 1 to 3 of 4 stay, each new sender takes the last."""
    inbox = filled([empty(agent) for agent in range(7)], limits=replace(LIMITS, max_senders=4))
    assert [m.agent_id for m in inbox.messages()] == [0, 1, 2, 6]
    inbox = filled([empty(agent) for agent in range(12)], limits=replace(LIMITS, max_senders=8))
    assert [m.agent_id for m in inbox.messages()] == [0, 1, 2, 3, 4, 5, 10, 11]
    inbox = filled([empty(agent) for agent in range(6)], limits=replace(LIMITS, max_senders=3))
    assert [m.agent_id for m in inbox.messages()] == [0, 1, 5]


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2), (2, 3, 1)])
@pytest.mark.parametrize("num_instants", [1, 3])
def test_of_silent_senders_the_one_that_sent_first_gives_way(order: tuple[int, ...], num_instants: int) -> None:
    inbox = Inbox(limits=replace(LIMITS, max_senders=3))
    for k in range(num_instants):
        for agent in order:
            inbox.push(empty(agent, NOW + k * TENTH_NS), NOW + k * TENTH_NS)
    later = NOW + LIMITS.max_silence_ns + num_instants * TENTH_NS
    inbox.push(empty(9, later), later)
    assert {m.agent_id for m in inbox.messages()} == {1, 2, 3, 9} - {order[0]}


def test_a_sender_is_silent_after_max_silence_and_not_before() -> None:
    limits = replace(LIMITS, max_senders=1)
    for wait_ns, kept in ((LIMITS.max_silence_ns, 1), (LIMITS.max_silence_ns + 1, 9)):
        inbox = Inbox(limits=limits)
        drive(inbox, range(1, 2), 0, 3)
        later = NOW + 2 * TENTH_NS + wait_ns
        inbox.push(empty(9, later), later)
        assert [m.agent_id for m in inbox.messages()] == [kept]


def test_a_new_instant_has_a_new_rate() -> None:
    limits = replace(LIMITS, max_instant_packets=2)
    packets = packets_of(replace(header(), tokens=tokens(80)))
    assert len(packets) > 4
    inbox = filled(packets, limits=limits)
    assert inbox.dropped == DropCounts(rate=len(packets) - 2)
    inbox.push(packets[2], NOW + limits.instant_ns - 1)
    assert inbox.dropped == DropCounts(rate=len(packets) - 1)
    inbox.push(packets[2], NOW + limits.instant_ns)
    inbox.messages()
    inbox.push(packets[3], NOW + limits.instant_ns)
    inbox.push(packets[4], NOW + limits.instant_ns)
    assert inbox.received_messages()[0].received_packets == 5


def test_the_bytes_of_an_instant_are_bounded() -> None:
    packets = packets_of(replace(header(), tokens=tokens(60)))
    inbox = filled(packets, limits=replace(LIMITS, max_instant_bytes=len(packets[0]) + len(packets[1])))
    assert inbox.dropped == DropCounts(rate=len(packets) - 2)


def test_one_sender_does_not_use_the_memory_of_another() -> None:
    """Half of the memory is divided among all places."""
    limits, cloud = replace(LIMITS, max_total_bytes=1 << 20, max_senders=4), PointCloud.of(torch.zeros(50_000, 3))
    inbox = filled([p for a in (1, 2, 3) for p in packets_of(replace(header(a), points=cloud), 1398)], limits=limits)
    assert inbox.dropped.full > 100
    before = inbox.dropped
    for packet in packets_of(replace(header(4), tokens=tokens(200)), 1398):
        inbox.push(packet, NOW)
    assert inbox.dropped == before and inbox.received_messages()[-1].complete


def test_of_silent_senders_the_least_trusted_gives_way() -> None:
    inbox = Inbox(limits=replace(LIMITS, max_senders=3))
    for agent in (1, 2, 3):
        inbox.push(empty(agent), NOW)
    inbox.set_trust({1: 0.9, 2: 0.4, 3: 0.8})
    later = NOW + LIMITS.max_silence_ns + TENTH_NS
    inbox.push(empty(9, later), later)
    assert {m.agent_id for m in inbox.messages()} == {1, 3, 9}


def test_a_sender_of_low_trust_gives_way_though_it_is_received_regularly() -> None:
    inbox = Inbox(limits=replace(LIMITS, max_senders=3))
    drive(inbox, range(1, 4), 0, 5)
    drive(inbox, range(9, 10), 5, 6)
    assert {m.agent_id for m in inbox.messages()} == {1, 2, 3}
    inbox.set_trust({2: 0.1})
    drive(inbox, range(9, 10), 6, 7)
    assert {m.agent_id for m in inbox.messages()} == {1, 3, 9}
