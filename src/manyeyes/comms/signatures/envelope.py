# SPDX-License-Identifier: Apache-2.0
"""Signed packets: the envelope around a packet of the wire format. It is modelled on IEEE 1609.2 / ETSI TS 103 097.

All numbers are little-endian:

====== ======== =======================================================================================
offset bytes    meaning
====== ======== =======================================================================================
0      2        ``MS``
2      1        suite: 1 is Ed25519 (RFC 8032)
3      1        flags: bit 0 a certificate is attached, others zero
4      8        signer: the last 8 bytes of the SHA-256 of its certificate
12     0 or 126 certificate (``comms.signatures.certificate``)
...    ...      the packet, unchanged, from ``ME`` to its checksum
end-64 64       signature of ``CONTEXT`` and everything before it
====== ======== =======================================================================================

Each packet has its signer and its signature, so that it is verified alone. This module knows the layout only: keys are held by
``manyeyes.runtime``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from manyeyes.comms.primitives import PacketError
from manyeyes.comms.signatures.certificate import CERTIFICATE_BYTES, IDENTIFIER_BYTES, SIGNATURE_BYTES

MAGIC = b"MS"
ED25519 = 1
CONTEXT = b"manyeyes packet 1\0"
"""What a signature begins with, so that it is valid for packets only."""
_HAS_CERTIFICATE = 1
_START_BYTES = 4 + IDENTIFIER_BYTES
ENVELOPE_BYTES = _START_BYTES + SIGNATURE_BYTES
"""Bytes that a signature adds to a packet, without a certificate."""


@dataclass(frozen=True)
class EnvelopeSize:
    """Bytes that signing adds: to each packet, and once to one packet of the message. A byte budget includes both."""

    packet_bytes: int = 0
    message_bytes: int = 0

    @property
    def max_bytes(self) -> int:
        """Bytes that signing adds to the packet that it adds most to."""
        return self.packet_bytes + self.message_bytes


UNSIGNED = EnvelopeSize()
SIGNED = EnvelopeSize(ENVELOPE_BYTES)
SIGNED_WITH_CERTIFICATE = EnvelopeSize(ENVELOPE_BYTES, CERTIFICATE_BYTES)


class SignedPacket(NamedTuple):
    """The parts of a signed packet; nothing is verified. content: what the signature is of. packet: of the wire format."""

    signer: bytes
    certificate: bytes | None
    packet: bytes
    content: bytes
    signature: bytes


def is_signed(packet: bytes) -> bool:
    """Return whether a packet begins as a signed one."""
    return bytes(packet[:2]) == MAGIC


def split_signed(packet: bytes) -> SignedPacket:
    """Return the parts of a signed packet.

    Raises:
        PacketError: garbage: it is too short, or has unknown flags; version: its suite is not known.
    """
    packet = packet if type(packet) is bytes else bytes(memoryview(packet))
    if len(packet) < ENVELOPE_BYTES or not is_signed(packet) or packet[3] & ~_HAS_CERTIFICATE:
        raise PacketError(
            "garbage", f"Not a signed packet: {len(packet)} bytes, expected at least {ENVELOPE_BYTES} from {MAGIC!r}."
        )
    if packet[2] != ED25519:
        raise PacketError("version", f"Suite {packet[2]} of a signature is not known here; expected {ED25519}.")
    begin = _START_BYTES + CERTIFICATE_BYTES * packet[3]
    if len(packet) < begin + SIGNATURE_BYTES:
        raise PacketError("garbage", f"Truncated packet: {len(packet)} bytes do not hold a certificate.")
    certificate = packet[_START_BYTES:begin] or None
    signer, end = packet[4:_START_BYTES], len(packet) - SIGNATURE_BYTES
    return SignedPacket(signer, certificate, packet[begin:end], CONTEXT + packet[:end], packet[end:])


def join_signed(signer: bytes, certificate: bytes | None, packet: bytes, sign: Callable[[bytes], bytes]) -> bytes:
    """Return a packet in its envelope. sign: makes the signature of bytes."""
    start = MAGIC + bytes((ED25519, 0 if certificate is None else _HAS_CERTIFICATE)) + signer
    content = start + (certificate or b"") + packet
    return content + sign(CONTEXT + content)
