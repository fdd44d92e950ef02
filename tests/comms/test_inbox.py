# SPDX-License-Identifier: Apache-2.0
"""The inbox: newest per agent, counted refusals, bounded memory, no crash."""

import zlib
from dataclasses import replace

import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms.drop_counts import DropCounts
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.comms.wire import encode
from manyeyes.datatypes import BevGrid, Boxes, Message, Sites, SparseBev, Transform

torch.set_num_threads(1)
GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)
TENTH_NS = 100_000_000
MODEL, OTHER = b"model-01", b"model-02"


def make_message(
    agent: int = 1, time: int = 0, cells: int = 60, objects: int = 2, fingerprint: bytes = MODEL
) -> Message:
    g = torch.Generator().manual_seed(agent * 1000 + time)
    key = torch.randperm(2112, generator=g)[:cells].sort().values
    boxes = Boxes.of(torch.rand(objects, 3, generator=g), torch.ones(objects, 3), torch.zeros(objects))
    return Message(
        agent,
        time,
        Transform.from_xyz_yaw(agent, time % 1000),
        torch.eye(3, dtype=torch.float64),
        fingerprint,
        tokens=SparseBev(torch.randn(cells, 4, generator=g), Sites(key, GRID)),
        token_score=torch.rand(cells, generator=g),
        objects=boxes,
    )


def packets_of(message: Message) -> list[bytes]:
    return encode(message, token_encoding="float32", mtu=400)


def filled(packets, **options) -> Inbox:
    inbox = Inbox(**options)
    for packet in packets:
        inbox.push(packet)
    return inbox


def written(inbox: Inbox) -> list[bytes]:
    """What an inbox holds, to the bit."""
    return [p for m in inbox.messages() for p in encode(m, token_encoding="float32", mtu=60000)]


def test_newest_of_each_agent_in_order_of_id():
    packets = [
        p
        for agent, time in ((7, 5 * TENTH_NS), (2, 9 * TENTH_NS), (7, 6 * TENTH_NS), (2, 8 * TENTH_NS), (-3, 0))
        for p in packets_of(make_message(agent, time))
    ]
    inbox = filled(packets)
    assert [(m.agent_id, m.timestamp_ns) for m in inbox.messages()] == [(-3, 0), (2, 9 * TENTH_NS), (7, 6 * TENTH_NS)]
    assert all(r.complete for r in inbox.received_messages())
    assert inbox.dropped == DropCounts(superseded=len(packets_of(make_message(2, 8 * TENTH_NS))))


def test_a_part_of_a_message_is_given_and_counted():
    packets = packets_of(make_message())
    inbox = filled(packets[:2])
    (reception,) = inbox.received_messages()
    assert (reception.received_packets, reception.expected_packets) == (2, len(packets))
    assert not reception.complete
    assert 0 < len(reception.message.tokens.sites) < 60
    assert len(reception.message.objects) == 2
    for packet in packets[2:]:
        inbox.push(packet)
    assert inbox.received_messages()[0].complete


def test_tokens_of_another_model_are_refused_and_the_objects_are_used():
    packets = packets_of(make_message(fingerprint=OTHER))
    inbox = filled(packets, fingerprint=MODEL)
    (message,) = inbox.messages()
    assert message.tokens is None
    assert len(message.objects) == 2
    assert inbox.dropped == DropCounts(wrong_model=len(packets) - 1)
    assert filled(packets, fingerprint=None).messages()[0].tokens is not None
    assert filled(packets, fingerprint=OTHER).dropped.total == 0


@given(st.lists(st.binary(max_size=200), max_size=20), st.randoms(use_true_random=False))
def test_garbage_copies_and_order_change_nothing(noise, random):
    clean = [p for agent in (1, 2, 3) for p in packets_of(make_message(agent))]
    mixed = clean + [b"ME\x02" + n for n in noise] + noise + random.choices(clean, k=5)
    mixed += [clean[0][: random.randrange(len(clean[0]))], clean[1] + b"!"]
    random.shuffle(mixed)
    inbox = filled(mixed)
    assert written(inbox) == written(filled(clean))
    assert inbox.dropped.duplicate == 5
    assert inbox.dropped.total == len(mixed) - len(clean)


@given(st.data())
def test_a_flipped_bit_is_never_taken(data):
    packets = packets_of(make_message())
    k = data.draw(st.integers(0, len(packets) - 1))
    bit = data.draw(st.integers(0, len(packets[k]) * 8 - 1))
    damaged = bytearray(packets[k])
    damaged[bit // 8] ^= 1 << bit % 8
    inbox = filled([bytes(damaged), *packets])
    assert inbox.dropped.total == 1
    assert written(inbox) == written(filled(packets))


def test_each_reason_is_counted_under_its_name():
    packet = packets_of(make_message())[0]
    old = bytearray(packet)
    old[2] = 9
    far = packet[:20] + b"\0\0\0\0\0\x80" + packet[26:-4]
    far += zlib.crc32(far).to_bytes(4, "little")
    moved = packets_of(replace(make_message(), world_from_agent=Transform.identity()))[1]
    inbox = filled([packet, b"", bytes(old), packet[:-1] + bytes([packet[-1] ^ 1]), far, moved, packet])
    wanted = {"garbage": 1, "version": 1, "checksum": 1, "implausible": 1, "contradiction": 1, "duplicate": 1}
    assert inbox.dropped == DropCounts(**wanted)
    assert inbox.dropped.total == 6


def test_old_messages_are_neither_taken_nor_given():
    inbox = Inbox(limits=ReceiverLimits(max_age_ns=100))
    inbox.push(packets_of(make_message(1, 1000))[0], arrival_ns=1101)
    assert inbox.messages() == ()
    assert inbox.dropped == DropCounts(expired=1)
    inbox.push(packets_of(make_message(1, 1000))[0], arrival_ns=1100)
    (reception,) = inbox.received_messages(now_ns=1100)
    assert reception.age_ns(1100) == 100
    assert reception.last_arrival_ns == 1100
    assert inbox.messages(now_ns=1101) == ()


def test_an_hour_old_message_is_not_given_by_default():
    inbox = filled(packets_of(make_message(1, 0)))
    assert len(inbox.messages(now_ns=TENTH_NS)) == 1
    assert inbox.messages(now_ns=36_000 * TENTH_NS) == ()


def test_the_bytes_of_one_message_are_bounded():
    packets = packets_of(make_message(cells=600))
    inbox = filled(packets, limits=ReceiverLimits(max_message_bytes=2000))
    (reception,) = inbox.received_messages()
    assert sum(sorted(map(len, packets))[: reception.received_packets]) <= 2000
    assert reception.received_packets > 3
    assert inbox.dropped == DropCounts(message_size=len(packets) - reception.received_packets)


@pytest.mark.parametrize("junk", [None, 3, "text"])
def test_a_packet_that_is_not_bytes_raises(junk):
    with pytest.raises(TypeError):
        Inbox().push(junk)
