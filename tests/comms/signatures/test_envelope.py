# SPDX-License-Identifier: Apache-2.0
"""Envelope and certificate: the layouts that their modules state, byte by byte; anything else is refused by name."""

from __future__ import annotations

import hashlib
import struct

import pytest
from hypothesis import given, strategies as st

from manyeyes.comms.network.tiles import NetworkTile
from manyeyes.comms.primitives import PacketError
from manyeyes.comms.signatures.certificate import CERTIFICATE_BYTES, RIGHTS, Area, Certificate
from manyeyes.comms.signatures.envelope import CONTEXT, ENVELOPE_BYTES, join_signed, split_signed
from manyeyes.datatypes import ConfigError, WireError

SIGNER, PACKET, TICKET = b"signer-1", b"ME packet", bytes(range(126))


def make_certificate(**changes) -> Certificate:
    values = {
        "rights": frozenset({"objects", "infrastructure"}),
        "agent_id": -5,
        "not_before_s": 1_800_000_000,
        "lifetime_min": 60,
        "area": Area(-2, 3, 4, 5),
        "public_key": bytes(range(32)),
        "issuer": b"issuer-1",
        "signature": bytes(range(64)),
    }
    return Certificate(**(values | changes))


def test_an_envelope_is_76_bytes_and_a_certificate_126() -> None:
    assert (ENVELOPE_BYTES, CERTIFICATE_BYTES) == (76, 126)
    assert len(join_signed(SIGNER, None, PACKET, lambda _: bytes(64))) == len(PACKET) + 76
    assert len(join_signed(SIGNER, TICKET, PACKET, lambda _: bytes(64))) == len(PACKET) + 202


def test_three_packets_of_a_message_of_4096_bytes_cost_less_than_six_percent() -> None:
    assert 3 * ENVELOPE_BYTES / 4096 < 0.06


@pytest.mark.parametrize("certificate", [None, TICKET])
def test_the_signature_is_of_all_that_precedes_it(certificate: bytes | None) -> None:
    signed: list[bytes] = []
    data = join_signed(SIGNER, certificate, PACKET, lambda content: signed.append(content) or bytes(range(64)))
    assert signed == [CONTEXT + data[:-64]]
    assert data[:12] == b"MS\x01" + bytes([certificate is not None]) + SIGNER
    parts = split_signed(data)
    assert (parts.signer, parts.certificate, parts.packet) == (SIGNER, certificate, PACKET)
    assert (parts.content, parts.signature) == (signed[0], bytes(range(64)))


@pytest.mark.parametrize(
    ("at", "value", "reason"), [(0, 0x4D + 1, "garbage"), (2, 2, "version"), (2, 0, "version"), (3, 2, "garbage")]
)
def test_unknown_fields_are_refused(at: int, value: int, reason: str) -> None:
    data = bytearray(join_signed(SIGNER, None, PACKET, lambda _: bytes(64)))
    data[at] = value
    with pytest.raises(PacketError) as found:
        split_signed(bytes(data))
    assert found.value.reason == reason


@given(st.binary(max_size=300))
def test_any_bytes_are_parts_or_a_packet_error(data: bytes) -> None:
    for packet in (data, b"MS\x01\x00" + data, b"MS\x01\x01" + data):
        try:
            parts = split_signed(packet)
        except PacketError:
            continue
        assert join_signed(parts.signer, parts.certificate, parts.packet, lambda _, p=parts: p.signature) == packet


def test_a_certificate_has_the_stated_layout() -> None:
    certificate = make_certificate()
    data = certificate.pack()
    fields = struct.unpack("<BBHiIH4h32s8s64s", data)
    assert fields[:6] == (1, 1, 0b010001, -5, 1_800_000_000, 60) and fields[6:10] == (-2, 3, 4, 5)
    assert fields[10:] == (bytes(range(32)), b"issuer-1", bytes(range(64)))
    assert Certificate.read(data) == certificate
    assert certificate.identifier == hashlib.sha256(data).digest()[24:]
    assert certificate.not_after_s == 1_800_003_600


def test_a_certificate_is_valid_within_its_period_and_a_minute() -> None:
    certificate = make_certificate()
    times = (1_799_999_939, 1_799_999_940, 1_800_003_660, 1_800_003_661)
    assert [certificate.is_valid_at(t) for t in times] == [False, True, True, False]


@pytest.mark.parametrize(("at", "value"), [(0, 2), (1, 2), (2, 0), (3, 0xFF), (18, 0)])
def test_a_damaged_certificate_is_refused(at: int, value: int) -> None:
    data = bytearray(make_certificate(rights=frozenset({"objects"})).pack())
    data[at] = value
    with pytest.raises(WireError):
        Certificate.read(bytes(data))
    with pytest.raises(WireError):
        Certificate.read(bytes(data[:-1]))


def test_zero_area_is_anywhere_and_all_rights_survive() -> None:
    certificate = make_certificate(area=None, rights=frozenset(RIGHTS))
    assert certificate.pack()[14:22] == bytes(8) and Certificate.read(certificate.pack()) == certificate


def test_an_area_contains_its_squares() -> None:
    area = Area(-1, 0, 2, 1)
    places = {(-500.0, 0.0): True, (499.9, 499.9): True, (500.0, 0.0): False, (0.0, 500.0): False, (0.0, -0.1): False}
    assert {place: area.contains(*place) for place in places} == places
    assert Area(0, 0).is_within(area) and not Area(0, 0, 2, 1).is_within(area)


def test_tiles_have_names_neighbours_and_hysteresis() -> None:
    here = NetworkTile.at(-0.1, 500.0)
    assert here == NetworkTile(-1, 1) and NetworkTile.of_name(here.name) == here and len(here.with_neighbours()) == 9
    assert here.is_next_to(NetworkTile(0, 2)) and not here.is_next_to(NetworkTile(1, 1))
    assert here.move_to(49.0, 700.0) == here and here.move_to(51.0, 700.0) == NetworkTile(0, 1)
    with pytest.raises(ConfigError, match="g0_-3"):
        NetworkTile.of_name("u33dc0")
