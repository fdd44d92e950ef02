# SPDX-License-Identifier: Apache-2.0
"""The sight of a sender on the wire: one packet of 180 bytes of content, checked, and no loss to a reader that does not know it."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import payloads, wire
from manyeyes.comms.inbox import Inbox
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.receiver_limits import ReceiverLimits
from manyeyes.datatypes import Boxes, Message, Sight, Transform, WireError

STEPS = np.arange(180) % 256
BOXES = Boxes.of(torch.tensor([[1.0, -2.0, 0.8]]), torch.tensor([[4.5, 1.8, 1.6]]), torch.tensor([0.3]))


def message(sight: Sight | None = None, objects: Boxes | None = BOXES) -> Message:
    pose = Transform.from_xyz_yaw(10.0, -5.0, 1.0, 0.3)
    return Message(7, 1_000, pose, torch.eye(3).double() * 0.01, objects=objects, sight=sight or Sight(STEPS))


def forge(packet: bytes, content: bytes, kind: int = payloads.SIGHT) -> bytes:
    """Return the packet with another body and a right checksum."""
    changed = packet[:3] + bytes([packet[3] & ~7 | kind]) + packet[4 : wire.HEADER_BYTES - 4] + content
    return changed + struct.pack("<I", zlib.crc32(changed))


def sight_packet(sent: Message) -> bytes:
    (packet,) = (packet for packet in wire.encode(sent) if packet[3] & 7 == payloads.SIGHT)
    return packet


@given(st.lists(st.integers(0, 255), min_size=180, max_size=180))
def test_a_sight_comes_back_without_loss(steps):
    back = wire.assemble(map(wire.decode_packet, wire.encode(message(Sight(np.array(steps))))))
    assert back.sight is not None and back.sight.steps.tolist() == steps
    assert back.objects is not None and len(back.objects) == 1


def test_it_costs_180_bytes_in_a_packet_of_its_own_after_the_objects():
    packets, without = wire.encode(message()), wire.encode(replace(message(), sight=None))
    assert [packet[3] & 7 for packet in packets] == [payloads.OBJECTS, payloads.SIGHT]
    assert sum(map(len, packets)) - sum(map(len, without)) == wire.SIGHT_PACKET_BYTES == 248
    assert 180 / 4096 < 0.0441 and len(sight_packet(message())) == 248


def test_a_message_may_be_a_sight_alone():
    (packet,) = wire.encode(message(objects=None))
    back = wire.assemble([wire.decode_packet(packet)])
    assert back.objects is None and back.sight is not None


@pytest.mark.parametrize("size", [0, 1, 179, 181, 360, 1300])
def test_another_length_is_garbage(size):
    with pytest.raises(PacketError, match="180 bytes, one a sector") as caught:
        wire.decode_packet(forge(sight_packet(message()), bytes(size)))
    assert caught.value.reason == "garbage"


def test_a_truncated_packet_fails_its_checksum():
    packet = sight_packet(message())
    for cut in range(1, 181):
        with pytest.raises(PacketError) as caught:
            wire.decode_packet(packet[:-cut])
        assert caught.value.reason == "checksum"


def test_a_second_sight_contradicts_the_first():
    packet = sight_packet(message())
    inbox = Inbox()
    inbox.push(packet)
    # The same content as packet 0 of the two.
    again = packet[:4] + b"\0\0" + packet[6:-4]
    inbox.push(again + struct.pack("<I", zlib.crc32(again)))
    assert inbox.dropped.contradiction == 1 and inbox.messages()[0].sight is not None


def test_a_range_beyond_the_bound_of_the_receiver_is_refused():
    near, far = (sight_packet(message(Sight(np.full(180, steps)))) for steps in (200, 201))
    for packet, refused in ((near, 0), (far, 1)):
        inbox = Inbox(limits=ReceiverLimits(max_range_m=100.0))
        inbox.push(packet)
        assert inbox.dropped.range == refused
    inbox = Inbox()
    inbox.push(sight_packet(message(Sight(np.full(180, 255)))))
    assert inbox.dropped.range == 0 and len(inbox.messages()) == 1


def test_a_reader_that_does_not_know_a_section_uses_the_others():
    """Kind 7 is as unknown to this reader as kind 6 is to one of before: the packet is garbage, the objects are used."""
    objects, sight = wire.encode(message())
    inbox = Inbox()
    for packet in (objects, forge(sight, STEPS.astype(np.uint8).tobytes(), kind=7)):
        inbox.push(packet)
    (received,) = inbox.received_messages()
    assert inbox.dropped.garbage == 1 and inbox.dropped.checksum == 0
    assert received.message.objects is not None and received.message.sight is None and not received.complete


def test_a_lost_sight_costs_nothing_else():
    objects, sight = wire.encode(message())
    assert wire.assemble([wire.decode_packet(objects)]).sight is None
    assert wire.assemble([wire.decode_packet(sight)]).objects is None


def test_a_packet_that_is_too_small_for_a_sight_is_an_error_of_the_sender():
    assert max(map(len, wire.encode(message(), mtu=248))) == 248
    with pytest.raises(WireError, match="raise the mtu"):
        wire.encode(message(), mtu=247)
