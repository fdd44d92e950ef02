# SPDX-License-Identifier: Apache-2.0
"""What is forged, truncated, replayed, expired, revoked or out of place is refused by name, before any state changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.runtime.conftest import START_S, Federation

from manyeyes.comms.inbox import Inbox
from manyeyes.comms.network.interface import Origin
from manyeyes.comms.signatures.certificate import SENDER_RIGHTS, Area, make_identifier
from manyeyes.comms.signatures.envelope import SIGNED, SIGNED_WITH_CERTIFICATE
from manyeyes.comms.wire import encode
from manyeyes.datatypes import Boxes, Message, Transform
from manyeyes.runtime.authentication import (
    FORGED_INSTANTS,
    MAX_FORGED_VERIFICATIONS,
    MAX_UNSIGNED,
    MAX_VERIFICATIONS,
    REPLAY_STAMPS,
    PacketVerifier,
)
from manyeyes.runtime.keys import Identity, Issuer, Validity, generate_key, public_bytes
from manyeyes.runtime.signing import PacketSigner
from manyeyes.runtime.trust_file import Anchor, Revocations, Trust

NOW = START_S * 10**9
TENTH_NS, MINUTE_NS = 10**8, 60 * 10**9


def make_message(agent_id: int = 1, stamp_ns: int = NOW, x_m: float = 0.0, num_boxes: int = 30) -> list[bytes]:
    """Packets of a message with boxes: two or more of them."""
    boxes = Boxes.of(torch.zeros(num_boxes, 3), torch.ones(num_boxes, 3), torch.zeros(num_boxes))
    pose = Transform.from_xyz_yaw(x_m, 2.0)
    message = Message(agent_id, stamp_ns, pose, torch.eye(3, dtype=torch.float64), bytes(8), objects=boxes)
    return encode(message, mtu=300)


def signed(identity: Identity, packets: list[bytes], time_ns: int = NOW) -> list[bytes]:
    return PacketSigner(identity).sign(packets, time_ns)


def receive(
    trust: Trust, packets: list[bytes], arrival_ns: int = NOW, mode: str = "require", links: tuple[str, ...] = ("",)
) -> Inbox:
    inbox = Inbox(authenticator=PacketVerifier(trust, mode))
    for number, packet in enumerate(packets):
        inbox.push(packet, arrival_ns, Origin(links[number % len(links)]))
    return inbox


def refusals(inbox: Inbox) -> dict[str, int]:
    return {name: count for name, count in vars(inbox.dropped).items() if count}


def test_signed_packets_are_the_message_that_was_signed(federation: Federation) -> None:
    packets = make_message()
    inbox = receive(federation.trust, signed(federation.identity(1), packets))
    (got,) = inbox.received_messages(NOW)
    assert got.complete and got.expected_packets == len(packets) > 1 and refusals(inbox) == {}
    plain = Inbox()
    for packet in packets:
        plain.push(packet, NOW)
    assert torch.equal(got.message.objects.bev(), plain.messages(NOW)[0].objects.bev())


def test_mode_off_reads_no_signed_packet_and_unsigned_ones_as_before(federation: Federation) -> None:
    inbox = Inbox()
    for packet in signed(federation.identity(1), make_message()):
        inbox.push(packet, NOW)
    assert refusals(inbox) == {"garbage": len(make_message())}


def test_the_certificate_is_attached_to_one_packet_a_second_and_on_request(federation: Federation) -> None:
    signer, sizes = PacketSigner(federation.identity(1)), list[list[int]]()
    plain = [len(packet) for packet in make_message()]
    for tenth in range(12):
        time_ns = NOW + tenth * TENTH_NS
        if tenth == 11:
            signer.request_certificate()
        expected = SIGNED_WITH_CERTIFICATE if tenth in (0, 10, 11) else SIGNED
        assert signer.envelope(time_ns) == expected
        packets = signer.sign(make_message(stamp_ns=time_ns), time_ns)
        sizes.append([len(packet) - size - 76 for packet, size in zip(packets, plain)])
    assert [row[0] for row in sizes] == [126, *[0] * 9, 126, 126] and not any(any(row[1:]) for row in sizes)


def test_a_signer_is_unknown_without_its_certificate_and_known_with_it(federation: Federation) -> None:
    packets = signed(federation.identity(1), make_message())
    inbox = receive(federation.trust, [packets[1], packets[0], packets[1]])
    assert refusals(inbox) == {"unknown_signer": 1}


@pytest.mark.parametrize("at", [3, 5, 12, 40, 150, 200, -70, -1])
def test_no_changed_byte_passes(federation: Federation, at: int) -> None:
    """Flags, signer, certificate, packet and signature, with the checksum of the packet made right where it would be wrong."""
    packet = bytearray(signed(federation.identity(1), make_message())[0])
    packet[at] ^= 1
    inbox = receive(federation.trust, [bytes(packet)])
    assert inbox.messages(NOW) == () and inbox.dropped.total == 1


def test_a_signature_of_another_key_is_forged(federation: Federation) -> None:
    victim, outsider = federation.identity(1), generate_key()
    stolen = PacketSigner(victim)
    stolen.identity = replace(victim, key=victim.key)
    object.__setattr__(stolen.identity, "key", outsider)
    assert refusals(receive(federation.trust, stolen.sign(make_message(), NOW)))["forged"] == len(make_message())


@pytest.mark.parametrize("length", [0, 2, 75, 76, 140, 201, 260])
def test_truncated_packets_are_refused(federation: Federation, length: int) -> None:
    inbox = receive(federation.trust, [signed(federation.identity(1), make_message())[0][:length]])
    assert inbox.messages(NOW) == () and inbox.dropped.total == 1


def test_replayed_packets_are_refused_before_they_are_verified(federation: Federation) -> None:
    packets = signed(federation.identity(1), make_message())
    inbox = receive(federation.trust, packets + packets * 300)
    assert refusals(inbox) == {"replayed": 300 * len(packets)}


def test_stamps_older_than_those_that_are_kept_are_replayed(federation: Federation) -> None:
    signer, packets = PacketSigner(federation.identity(1)), list[bytes]()
    for k in range(REPLAY_STAMPS + 1):
        packets += signer.sign(make_message(stamp_ns=NOW + 30 * 10**6 * k, num_boxes=1), NOW)
    inbox = receive(federation.trust, [*packets, packets[0], packets[1]], NOW + 250 * 10**6)
    assert inbox.dropped.replayed == 2


def test_a_certificate_is_of_one_agent_id(federation: Federation) -> None:
    assert set(refusals(receive(federation.trust, signed(federation.identity(1), make_message(2))))) == {
        "identity",
        "unknown_signer",
    } - {"unknown_signer"}


@pytest.mark.parametrize(
    ("rights", "infrastructure"), [({"tokens"}, False), ({"objects"}, True)], ids=["objects", "infrastructure"]
)
def test_a_certificate_grants_rights(federation: Federation, rights: set, infrastructure: bool) -> None:
    boxes = Boxes.of(torch.zeros(1, 3), torch.ones(1, 3), torch.zeros(1))
    pose, covariance = Transform.from_xyz_yaw(0.0, 0.0), torch.eye(3, dtype=torch.float64)
    packets = encode(Message(1, NOW, pose, covariance, is_infrastructure=infrastructure, objects=boxes))
    inbox = receive(federation.trust, signed(federation.identity(1, frozenset(rights)), packets))
    assert refusals(inbox) == {"certificate": 1}


@pytest.mark.parametrize("minutes", [-3, 62])
def test_an_expired_or_future_certificate_is_refused(federation: Federation, minutes: int) -> None:
    later = NOW + minutes * MINUTE_NS
    packets = signed(federation.identity(1), make_message(stamp_ns=later, num_boxes=1), later)
    assert refusals(receive(federation.trust, packets, later)) == {"certificate": 1}


def test_a_certificate_that_expires_while_it_is_used_is_refused(federation: Federation) -> None:
    identity = federation.identity(1, valid=Validity(START_S - 120, 1))
    signer, inbox = PacketSigner(identity), Inbox(authenticator=PacketVerifier(federation.trust))
    for stamp in (NOW, NOW + TENTH_NS):
        inbox.push(signer.sign(make_message(stamp_ns=stamp, num_boxes=1), stamp)[0], stamp)
    assert refusals(inbox) == {"certificate": 1}


def test_a_certificate_is_of_an_area(federation: Federation) -> None:
    identity = federation.identity(1, valid=Validity(START_S - 60, 60, Area(0, 0)))
    assert refusals(receive(federation.trust, signed(identity, make_message(x_m=10.0)))) == {}
    outside = receive(federation.trust, signed(identity, make_message(x_m=-10.0)))
    assert set(refusals(outside)) == {"certificate"}


@pytest.mark.parametrize("what", ["signers", "issuers"])
def test_revocation_ends_what_was_accepted_before(federation: Federation, what: str) -> None:
    identity = federation.identity(1)
    signer, verifier = PacketSigner(identity), PacketVerifier(federation.trust)
    inbox = Inbox(authenticator=verifier)
    inbox.push(signer.sign(make_message(num_boxes=1), NOW)[0], NOW)
    listed = {identity.certificate.identifier if what == "signers" else identity.certificate.issuer}
    verifier.replace_trust(replace(federation.trust, revoked=Revocations(**{what: frozenset(listed)})))
    inbox.push(signer.sign(make_message(stamp_ns=NOW + TENTH_NS, num_boxes=1), NOW)[0], NOW + TENTH_NS)
    assert refusals(inbox) == {"revoked": 1}


@pytest.mark.parametrize(("mode", "expected"), [("warn", {}), ("require", {"certificate": 1})])
def test_an_overdue_list_of_revocations_ends_trust_after_a_day_in_mode_require(federation, mode, expected) -> None:
    due = Revocations(next_s=START_S - 86_401.0)
    trust, packets = replace(federation.trust, revoked=due), make_message(num_boxes=1)
    assert PacketVerifier(trust).is_overdue(NOW)
    assert refusals(receive(trust, signed(federation.identity(1), packets), mode=mode)) == expected
    still = replace(due, next_s=START_S - 86_399.0)
    trust = replace(federation.trust, revoked=still)
    assert refusals(receive(trust, signed(federation.identity(1), packets), mode=mode)) == {}


def test_an_issuer_comes_from_the_trust_file_only_and_grants_no_more_than_it_has(federation: Federation) -> None:
    stranger = Issuer.of_anchor(generate_key())
    key = generate_key()
    unknown = Identity(key, stranger.issue(public_bytes(key), SENDER_RIGHTS, 1, Validity(START_S)))
    assert "certificate" in refusals(receive(federation.trust, signed(unknown, make_message())))
    # The holder of an agent's certificate signs one for another agent.
    agent = federation.identity(1)
    below = Issuer(agent.key, agent.certificate.identifier)
    third = Identity(key, below.issue(public_bytes(key), SENDER_RIGHTS, 2, Validity(START_S)))
    assert "certificate" in refusals(receive(federation.trust, signed(third, make_message(2))))
    limited = Anchor("map", public_bytes(generate_key()), frozenset({"map"}), START_S + 10**6)
    assert make_identifier(limited.public_key) == limited.identifier
    short = replace(
        federation.trust, anchors=(replace(federation.trust.anchors[0], rights=frozenset({"map", "issuer"})),)
    )
    assert "certificate" in refusals(receive(short, signed(federation.identity(1), make_message())))


def test_a_forged_certificate_of_a_known_issuer_is_refused(federation: Federation) -> None:
    certificate = federation.identity(1).certificate
    key = generate_key()
    forged = replace(certificate, public_key=public_bytes(key))
    inbox = receive(federation.trust, signed(Identity(key, forged), make_message(num_boxes=1)))
    assert refusals(inbox) == {"certificate": 1}


def test_mode_require_refuses_unsigned_packets_and_mode_warn_those_of_signed_senders(federation: Federation) -> None:
    packets = make_message(num_boxes=1)
    assert refusals(receive(federation.trust, packets)) == {"unsigned": 1}
    assert refusals(receive(federation.trust, packets, mode="warn")) == {}
    later = make_message(stamp_ns=NOW + 5 * 10**7, num_boxes=1)
    both = signed(federation.identity(1), packets) + later
    assert refusals(receive(federation.trust, both, mode="warn")) == {"unsigned": 1}


def test_mode_warn_accepts_a_few_unsigned_senders_each_on_its_link(federation: Federation) -> None:
    many = [make_message(agent, num_boxes=1)[0] for agent in range(MAX_UNSIGNED + 5)]
    inbox = receive(federation.trust, many, mode="warn")
    assert refusals(inbox) == {"unsigned": 5} and len(inbox.messages(NOW)) == MAX_UNSIGNED
    twice = [make_message(1, NOW, num_boxes=1)[0], make_message(1, NOW + 3 * 10**7, num_boxes=1)[0]]
    assert refusals(receive(federation.trust, twice, mode="warn", links=("a", "b"))) == {"identity": 1}


def test_links_share_the_verifications_of_an_instant(federation: Federation) -> None:
    """A flood with the certificate of a victim: the honest sender on another link is received at every instant after the first."""
    victim, honest = federation.identity(1), PacketSigner(federation.identity(2))
    stolen = PacketSigner(victim)
    object.__setattr__(stolen.identity, "key", generate_key())
    inbox = Inbox(authenticator=PacketVerifier(federation.trust))
    for instant in range(3):
        stamp = NOW + instant * TENTH_NS
        forged = stolen.sign(make_message(1, stamp, num_boxes=1), NOW)[0]
        for _ in range(MAX_VERIFICATIONS + 50):
            inbox.push(forged, stamp, Origin("flood"))
        inbox.push(honest.sign(make_message(2, stamp, num_boxes=1), stamp)[0], stamp, Origin("honest"))
        inbox.push(forged, stamp, Origin("flood"))
    (got,) = inbox.messages(NOW + 2 * TENTH_NS)
    assert got.agent_id == 2 and got.timestamp_ns == NOW + 2 * TENTH_NS
    assert inbox.dropped.busy > 100 and inbox.dropped.forged <= 3 * MAX_FORGED_VERIFICATIONS


def test_a_link_with_forged_packets_has_fewer_verifications_for_a_second(federation: Federation) -> None:
    signer, verifier = PacketSigner(federation.identity(1)), PacketVerifier(federation.trust)
    inbox = Inbox(authenticator=verifier)

    def count_verified(instant: int, *packets: bytes) -> int:
        """Of one packet in 60 messages of the instant's signer, how many are verified after others on their link."""
        stamp, before = NOW + instant * TENTH_NS, inbox.dropped.busy
        for packet in packets:
            inbox.push(packet, stamp, Origin("link"))
        many = [signer.sign(make_message(1, stamp + k, num_boxes=1), stamp)[0] for k in range(60)]
        for packet in many:
            inbox.push(packet, stamp, Origin("link"))
        return 60 - (inbox.dropped.busy - before)

    assert count_verified(0) == 60 and inbox.dropped.busy == inbox.dropped.unknown_signer == 0
    forged = bytearray(signer.sign(make_message(1, NOW + TENTH_NS, num_boxes=1), NOW)[0])
    forged[-1] ^= 1
    assert count_verified(1, bytes(forged)) == MAX_FORGED_VERIFICATIONS - 1
    assert count_verified(5) == MAX_FORGED_VERIFICATIONS
    assert count_verified(1 + FORGED_INSTANTS + 1) == 60
