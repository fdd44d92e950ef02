# SPDX-License-Identifier: Apache-2.0
"""Signing of packets: each packet gets an envelope, and one packet a second the certificate."""

from __future__ import annotations

from collections.abc import Sequence

from manyeyes.comms.signatures.envelope import SIGNED, SIGNED_WITH_CERTIFICATE, EnvelopeSize, join_signed
from manyeyes.runtime.keys import Identity

CERTIFICATE_PERIOD_NS = 1_000_000_000


class PacketSigner:
    """Signs the packets of one agent. The first packet of a message carries the certificate when it is due.

    It is due in the first message, once a second, and after :meth:`request_certificate`.
    """

    def __init__(self, identity: Identity) -> None:
        self.identity = identity
        self._certificate = identity.certificate.pack()
        self._last_ns: int | None = None

    def request_certificate(self) -> None:
        """Attach the certificate to the next message: a receiver may not know it yet."""
        self._last_ns = None

    def envelope(self, time_ns: int) -> EnvelopeSize:
        """Return the bytes that signing adds to a message of that time."""
        return SIGNED_WITH_CERTIFICATE if self._is_due(time_ns) else SIGNED

    def sign(self, packets: Sequence[bytes], time_ns: int) -> list[bytes]:
        """Return the packets of one message in envelopes."""
        attached = self._certificate if self._is_due(time_ns) else None
        if attached is not None and packets:
            self._last_ns = time_ns
        signer, key = self.identity.certificate.identifier, self.identity.key
        return [
            join_signed(signer, None if number else attached, packet, key.sign) for number, packet in enumerate(packets)
        ]

    def _is_due(self, time_ns: int) -> bool:
        return self._last_ns is None or abs(time_ns - self._last_ns) >= CERTIFICATE_PERIOD_NS
