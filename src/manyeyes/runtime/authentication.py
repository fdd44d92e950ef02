# SPDX-License-Identifier: Apache-2.0
"""Authentication of received packets by the certificates that a trust file admits. Modelled on IEEE 1609.2 / ETSI TS 103 097.

The cheapest check comes first: nothing is verified twice, and no more than MAX_VERIFICATIONS signatures at one instant, which links
share evenly. No check changes the state of a sender before the signature is valid.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from manyeyes.comms import payloads
from manyeyes.comms.drop_counts import AuthenticationRefusal
from manyeyes.comms.network.interface import Origin
from manyeyes.comms.signatures.certificate import Certificate, Right
from manyeyes.comms.signatures.envelope import SignedPacket
from manyeyes.comms.wire import Envelope
from manyeyes.datatypes import WireError
from manyeyes.runtime.keys import is_signature, read_public_key
from manyeyes.runtime.trust_file import Trust

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

SecurityMode = Literal["off", "warn", "require"]
"""off: nothing is signed, and signed packets are not read. warn: unsigned packets are accepted from a few senders. require: they
are refused."""

NS_PER_S = 1_000_000_000
INSTANT_NS = 100_000_000
MAX_VERIFICATIONS = 200
"""Number of signatures that are verified in INSTANT_NS of arrivals, 30 ms of CPU time."""
MAX_FORGED_VERIFICATIONS = 32
"""The same of one link from which a forged packet came within FORGED_INSTANTS."""
FORGED_INSTANTS = 10
MAX_TICKETS = 1_024
"""Number of verified certificates that are kept; the one that was not used for longest gives way."""
REPLAY_STAMPS = 8
"""Number of messages of a signer whose packet numbers are kept."""
MAX_UNSIGNED = 16
"""Number of unsigned senders that mode warn accepts at one time."""
UNSIGNED_SILENCE_NS = 2 * NS_PER_S
"""An unsigned id is bound to its link until it has been silent for this long."""
SIGNED_MEMORY_NS = 600 * NS_PER_S
"""A sender that was received signed is refused unsigned for this long."""
REVOCATION_GRACE_S = 86_400.0
"""Time after which a list of revocations that is overdue ends all trust in mode require."""
_RIGHTS: dict[int, Right] = {
    payloads.TOKENS: "tokens",
    payloads.REQUEST: "tokens",
    payloads.OBJECTS: "objects",
    payloads.POINTS: "points",
    payloads.ELEMENTS: "map",
    payloads.SIGHT: "objects",
}


@dataclass
class _Ticket:
    """A verified certificate. taken: packet numbers, as bits, of the last messages by their stamps."""

    certificate: Certificate
    public_key: Ed25519PublicKey
    taken: OrderedDict[int, int] = field(default_factory=OrderedDict[int, int])

    def is_replayed(self, stamp_ns: int, number: int) -> bool:
        if stamp_ns in self.taken:
            return bool(self.taken[stamp_ns] >> number & 1)
        return len(self.taken) >= REPLAY_STAMPS and stamp_ns < min(self.taken)

    def take(self, stamp_ns: int, number: int) -> None:
        self.taken[stamp_ns] = self.taken.get(stamp_ns, 0) | 1 << number
        if len(self.taken) > REPLAY_STAMPS:
            del self.taken[min(self.taken)]


class _Quota:
    """Number of verifications in an instant, shared evenly among the links of this and the last instant; forging links get less."""

    def __init__(self) -> None:
        self._instant, self._total = 0, 0
        self._used: dict[str, int] = {}
        self._forged: dict[str, int] = {}
        self._last: frozenset[str] = frozenset()

    def take(self, link: str, now_ns: int) -> bool:
        instant = now_ns // INSTANT_NS
        if instant != self._instant:
            self._last = frozenset(self._used) if instant == self._instant + 1 else frozenset()
            self._instant, self._total, self._used = instant, 0, {}
            self._forged = {one: at for one, at in self._forged.items() if 0 <= instant - at <= FORGED_INSTANTS}
        used = self._used.get(link, 0)
        self._used[link] = used + 1
        # One share is left for a link that is new.
        share = max(1, MAX_VERIFICATIONS // (1 + len(self._last | self._used.keys())))
        if link in self._forged:
            share = min(share, MAX_FORGED_VERIFICATIONS)
        if self._total >= MAX_VERIFICATIONS or used >= share:
            return False
        self._total += 1
        return True

    def record_forged(self, link: str) -> None:
        """Record that a packet of a link that was verified last was forged."""
        self._forged[link] = self._instant


@dataclass
class _Unsigned:
    link: str
    last_ns: int


class PacketVerifier:
    """Authenticator of an inbox (``comms.admission.Authenticator``) in mode warn or require.

    clock: nanoseconds since 1970, for packets without a time of arrival. utc_offset_ns: UTC, the time of certificates, less that of
    arrivals.
    """

    def __init__(
        self,
        trust: Trust,
        mode: Literal["warn", "require"] = "require",
        clock: Callable[[], int] = time.time_ns,
        utc_offset_ns: int = 0,
    ) -> None:
        self.mode, self.utc_offset_ns = mode, utc_offset_ns
        self._clock = clock
        self._tickets: OrderedDict[bytes, _Ticket] = OrderedDict()
        self._quota = _Quota()
        self._unsigned: dict[int, _Unsigned] = {}
        self._signed_ns: OrderedDict[int, int] = OrderedDict()
        self.replace_trust(trust)

    def replace_trust(self, trust: Trust) -> None:
        """Use another trust file from now on; certificates that it does not admit are refused at their next packet."""
        self.trust = trust
        self._grantors = trust.grantors()

    def is_overdue(self, now_ns: int) -> bool:
        """Return whether the next list of revocations was due before a time."""
        return self.trust.revoked.next_s is not None and now_ns / NS_PER_S > self.trust.revoked.next_s

    def check(
        self, envelope: Envelope, signed: SignedPacket | None, arrival_ns: int | None, origin: Origin
    ) -> AuthenticationRefusal | None:
        """Return why a packet is refused; None accepts it."""
        now_ns = self._clock() if arrival_ns is None else arrival_ns
        if signed is None:
            return self._check_unsigned(envelope.header.agent_id, now_ns, origin)
        ticket = self._find_ticket(signed, now_ns, origin)
        if isinstance(ticket, str):
            return ticket
        header, certificate = envelope.header, ticket.certificate
        reason = self._check_certificate(certificate, signed.signer, now_ns) or _check_claims(certificate, envelope)
        if reason is not None:
            return reason
        if ticket.is_replayed(header.timestamp_ns, envelope.number):
            return "replayed"
        if not self._quota.take(origin.link, now_ns):
            return "busy"
        if not is_signature(ticket.public_key, signed.signature, signed.content):
            self._quota.record_forged(origin.link)
            return "forged"
        ticket.take(header.timestamp_ns, envelope.number)
        self._tickets.move_to_end(signed.signer)
        self._record_signed(header.agent_id, now_ns)
        return None

    def _find_ticket(self, signed: SignedPacket, now_ns: int, origin: Origin) -> _Ticket | AuthenticationRefusal:
        """Return the certificate of a packet, verified now or before."""
        known = self._tickets.get(signed.signer)
        if known is not None:
            return known
        if signed.certificate is None:
            return "unknown_signer"
        try:
            certificate = Certificate.read(signed.certificate)
        except WireError:
            return "certificate"
        if certificate.identifier != signed.signer:
            return "certificate"
        reason = self._check_certificate(certificate, signed.signer, now_ns)
        if reason is not None:
            return reason
        if not self._quota.take(origin.link, now_ns):
            return "busy"
        issuer_key = read_public_key(self._grantors[certificate.issuer].public_key)
        if not is_signature(issuer_key, certificate.signature, certificate.signed_content):
            return "certificate"
        ticket = _Ticket(certificate, read_public_key(certificate.public_key))
        self._tickets[signed.signer] = ticket
        if len(self._tickets) > MAX_TICKETS:
            self._tickets.popitem(last=False)
        return ticket

    def _check_certificate(
        self, certificate: Certificate, identifier: bytes, now_ns: int
    ) -> AuthenticationRefusal | None:
        """Return why a certificate is not admitted now, apart from its signature."""
        now_ns += self.utc_offset_ns
        now_s, revoked = now_ns / NS_PER_S, self.trust.revoked
        if identifier in revoked.signers or certificate.issuer in revoked.issuers:
            return "revoked"
        issuer = self._grantors.get(certificate.issuer)
        if issuer is None or not issuer.covers(certificate) or not issuer.from_s <= now_s <= issuer.until_s:
            return "certificate"
        is_overdue = self.mode == "require" and self.is_overdue(now_ns - round(REVOCATION_GRACE_S * NS_PER_S))
        return "certificate" if is_overdue or not certificate.is_valid_at(now_s) else None

    def _check_unsigned(self, agent_id: int, now_ns: int, origin: Origin) -> AuthenticationRefusal | None:
        """Mode warn: a few senders, each on one link, none that was received signed before."""
        signed_ns = self._signed_ns.get(agent_id)
        if self.mode == "require" or (signed_ns is not None and now_ns - signed_ns <= SIGNED_MEMORY_NS):
            return "unsigned"
        known = self._unsigned.get(agent_id)
        if known is not None and now_ns - known.last_ns <= UNSIGNED_SILENCE_NS and known.link != origin.link:
            return "identity"
        if known is None and len(self._unsigned) >= MAX_UNSIGNED:
            oldest = min(self._unsigned, key=lambda other: self._unsigned[other].last_ns)
            if now_ns - self._unsigned[oldest].last_ns <= UNSIGNED_SILENCE_NS:
                return "unsigned"
            del self._unsigned[oldest]
        self._unsigned[agent_id] = _Unsigned(origin.link, now_ns)
        return None

    def _record_signed(self, agent_id: int, now_ns: int) -> None:
        self._unsigned.pop(agent_id, None)
        self._signed_ns.pop(agent_id, None)
        self._signed_ns[agent_id] = now_ns
        if len(self._signed_ns) > MAX_TICKETS:
            self._signed_ns.popitem(last=False)


def _check_claims(certificate: Certificate, envelope: Envelope) -> AuthenticationRefusal | None:
    """Return why a certificate does not admit the header and the kind of a packet."""
    header = envelope.header
    if header.agent_id != certificate.agent_id:
        return "identity"
    needed: set[Right] = {"infrastructure"} if header.is_infrastructure else set()
    if envelope.kind in _RIGHTS:
        needed.add(_RIGHTS[envelope.kind])
    is_inside = certificate.area is None or certificate.area.contains(header.pose[0], header.pose[1])
    return None if needed <= certificate.rights and is_inside else "certificate"
