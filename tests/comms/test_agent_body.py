# SPDX-License-Identifier: Apache-2.0
"""The sender's own vehicle on the wire: nine bytes of the first packet, bounded, optional in version 4."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import replace

import pytest
import torch
from hypothesis import given, strategies as st

from manyeyes.comms import wire
from manyeyes.comms.agent_body import AGENT_BODY_BYTES, pack_agent_body, read_agent_body
from manyeyes.comms.token_selection import select_within_budget
from manyeyes.datatypes import AgentBody, BevGrid, Boxes, ConfigError, Message, Sites, SparseBev, Transform

BODY = AgentBody.standing(1.42, -0.13, (4.9, 2.1, 1.8), 0.02)
GRID = BevGrid(-140.8, -38.4, -3.0, 140.8, 38.4, 1.0, 0.4, 8)


def message(num_tokens: int | None = 400, body: AgentBody | None = BODY) -> Message:
    rng = torch.Generator().manual_seed(0)
    tokens = None
    if num_tokens is not None:
        rows, columns = GRID.shape
        key = torch.randperm(rows * columns, generator=rng)[:num_tokens].sort().values
        tokens = SparseBev(torch.randn(num_tokens, 16, generator=rng), Sites(key, GRID))
    center = torch.rand(30, 3, generator=rng) * 80
    boxes = Boxes.of(center, torch.ones(30, 3) * 2, torch.zeros(30), torch.linspace(1, 0.1, 30))
    score = None if tokens is None else torch.rand(len(tokens.sites), generator=rng)
    pose = Transform.from_xyz_yaw(10.0, -5.0, 1.0, 0.3)
    return Message(
        7, 123, pose, torch.eye(3).double() * 0.01, tokens=tokens, token_score=score, objects=boxes, body=body
    )


def forge(packet: bytes, at: int, new: bytes) -> bytes:
    """Return the packet with other bytes and a right checksum."""
    changed = packet[:at] + new + packet[at + len(new) : -4]
    return changed + struct.pack("<I", zlib.crc32(changed))


def received(packets: list[bytes]) -> Message:
    return wire.assemble(map(wire.decode_packet, packets))


@given(
    st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    st.tuples(*[st.floats(0.05, 25)] * 3),
    st.floats(-3.2, 3.2),
)
def test_a_body_comes_back_within_its_units(
    xy: tuple[float, float], size: tuple[float, float, float], yaw: float
) -> None:
    back = read_agent_body(pack_agent_body(AgentBody.standing(*xy, size, yaw)))
    assert back.center[:2] == pytest.approx(xy, abs=0.0051) and back.size == pytest.approx(size, abs=0.0501)
    assert math.cos(back.yaw_rad - yaw) > math.cos(0.0002) and back.center[2] == back.size[2] / 2


def test_a_message_has_it_once_and_pays_nine_bytes() -> None:
    with_body, without = wire.encode(message()), wire.encode(message(body=None))
    assert len(with_body) == len(without) > 2
    assert sum(map(len, with_body)) - sum(map(len, without)) == AGENT_BODY_BYTES == 9
    assert received(with_body).body == AgentBody.standing(1.42, -0.13, (4.9, 2.1, 1.8), math.radians(1.15))
    assert received(without).body is None
    assert [packet[2] for packet in (*with_body, *without)] == [4] * (len(with_body) + len(without))
    assert len(received(with_body).objects or ()) == 30


def test_without_its_first_packet_the_body_is_unknown() -> None:
    packets = wire.encode(message())
    assert received(packets[1:]).body is None and received(packets[::-1]).body is not None


def test_a_message_with_nothing_else_is_one_packet() -> None:
    (packet,) = wire.encode(replace(message(None), objects=None))
    assert len(packet) == wire.HEADER_BYTES + 9 and received([packet]).body is not None


@pytest.mark.parametrize("mtu", [150, 200, 333, 1398])
def test_no_packet_is_longer_than_the_mtu(mtu: int) -> None:
    packets = wire.encode(message(), mtu=mtu)
    assert max(map(len, packets)) <= mtu and received(packets).body is not None
    tokens = received(packets).tokens
    assert tokens is not None and len(tokens.sites) == 400


def test_too_small_an_mtu_is_refused() -> None:
    with pytest.raises(ConfigError, match="mtu is from 98 to"):
        wire.encode(message(), mtu=97)


@pytest.mark.parametrize("budget", [400, 1398, 1500, 2801, 6000])
def test_a_budget_holds_with_a_body(budget: int) -> None:
    some = replace(message(), objects=None)
    assert some.tokens is not None and some.token_score is not None
    kept, score = select_within_budget(
        some.tokens, some.token_score, budget - 9, mtu=wire.DEFAULT_MTU - AGENT_BODY_BYTES
    )
    packets = wire.encode(replace(some, tokens=kept, token_score=score))
    assert budget - 200 < sum(map(len, packets)) <= budget


AT = wire.HEADER_BYTES - 4


@pytest.mark.parametrize(
    "at, new, reason",
    [
        (AT, struct.pack("<h", 2001), "implausible"),
        (AT + 2, struct.pack("<h", -32768), "implausible"),
        (AT + 4, struct.pack("<h", 18000), "implausible"),
        (AT + 6, b"\0", "implausible"),
        (AT + 8, b"\xfb", "implausible"),
        (2, b"\2", "garbage"),
        (2, b"\5", "version"),
        (4, b"\1\0", "garbage"),
        (3, b"\x82", "garbage"),
        (3, b"\x02", "garbage"),
    ],
)
def test_hostile_bodies_are_rejected(at: int, new: bytes, reason: str) -> None:
    first = wire.encode(message(None))[0]
    with pytest.raises(wire.PacketError) as caught:
        wire.decode_packet(forge(first, at, new))
    assert caught.value.reason == reason


def test_a_packet_that_ends_in_the_body_is_rejected() -> None:
    (packet,) = wire.encode(replace(message(None), objects=None))
    for cut in range(1, 10):
        short = packet[: -4 - cut]
        with pytest.raises(wire.PacketError):
            wire.decode_packet(short + struct.pack("<I", zlib.crc32(short)))
