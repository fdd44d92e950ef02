# SPDX-License-Identifier: Apache-2.0
"""CPU time of signed packets: to sign, to receive with and without verification, and to refuse forged ones.

Messages of three packets of 1,322 bytes, as of a budget of 4,096 bytes. Times are CPU time, the median of repeats in turn.
refused: a packet of a flood beyond the signatures that are verified at one instant.

python benchmarks/signatures.py [--repeats 30] [--out benchmarks/results/signatures.json]
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from manyeyes.comms.inbox import Inbox
from manyeyes.comms.network.interface import Origin
from manyeyes.comms.signatures.certificate import RIGHTS, SENDER_RIGHTS
from manyeyes.comms.signatures.envelope import ENVELOPE_BYTES
from manyeyes.comms.wire import encode
from manyeyes.datatypes import Boxes, Message, Transform
from manyeyes.runtime.authentication import MAX_VERIFICATIONS, PacketVerifier
from manyeyes.runtime.keys import Identity, Issuer, Validity, generate_key, public_bytes
from manyeyes.runtime.signing import PacketSigner
from manyeyes.runtime.trust_file import Anchor, Trust
from manyeyes.studies.provenance import write_json
from manyeyes.viz.study_table import StudyTable

NOW_NS, NUM_MESSAGES, PACKETS_PER_S = 1_800_000_000 * 10**9, 20, 300


@dataclass(frozen=True)
class Result:
    """CPU time a packet, microseconds. core_fraction: of a core, to sign 30 and to verify 300 packets a second."""

    packet_bytes: int
    sign_us: float
    receive_unsigned_us: float
    receive_signed_us: float
    refused_us: float
    core_fraction: float
    envelope_fraction_of_4096: float


def make_message(time_ns: int, agent_id: int = 1) -> list[bytes]:
    boxes = Boxes.of(torch.zeros(250, 3), torch.ones(250, 3), torch.zeros(250))
    return encode(Message(agent_id, time_ns, Transform.identity(), torch.eye(3), objects=boxes), mtu=1_322)


def make_table(result: Result) -> StudyTable:
    """Tabulate the result beside its bars."""
    lines = (
        ("to sign a packet", f"{result.sign_us:.1f} us", ""),
        ("to receive an unsigned packet", f"{result.receive_unsigned_us:.1f} us", ""),
        ("to receive a signed packet", f"{result.receive_signed_us:.1f} us", ""),
        ("to refuse a packet of a flood", f"{result.refused_us:.1f} us", ""),
        (
            "fraction of a core, 30 packets signed and 300 verified a second",
            f"{result.core_fraction:.1%}",
            "at most 5 %",
        ),
        ("envelope in a message of 4,096 bytes", f"{result.envelope_fraction_of_4096:.1%}", "at most 6 %"),
    )
    return StudyTable("Processor time and bytes of signatures", ("quantity", "value", "bar"), lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "signatures.json")
    arguments = parser.parse_args()
    anchor_key, key = generate_key(), generate_key()
    trust = Trust((Anchor("anchor", public_bytes(anchor_key), frozenset(RIGHTS), 2e9),))
    valid = Validity(NOW_NS // 10**9 - 60)
    identity = Identity(key, Issuer.of_anchor(anchor_key).issue(public_bytes(key), SENDER_RIGHTS, 1, valid))
    plain = [make_message(NOW_NS + k * 10**8) for k in range(NUM_MESSAGES)]
    signer = PacketSigner(identity)
    signed = [signer.sign(packets, NOW_NS + k * 10**8) for k, packets in enumerate(plain)]
    forged = signed[0][0][:-1] + bytes([signed[0][0][-1] ^ 1])

    def sign() -> int:
        return sum(len(PacketSigner(identity).sign(packets, NOW_NS)) for packets in plain)

    def receive(messages: list[list[bytes]], verifier: PacketVerifier | None) -> int:
        inbox = Inbox(authenticator=verifier)
        for k, packets in enumerate(messages):
            for packet in packets:
                inbox.push(packet, NOW_NS + k * 10**8)
        assert inbox.dropped.total == 0
        return sum(map(len, messages))

    def refuse() -> int:
        inbox, flood = flooded, 2_000
        for _ in range(flood):
            inbox.push(forged, NOW_NS, Origin("flood"))
        return flood

    flooded = Inbox(authenticator=PacketVerifier(trust))
    for _ in range(MAX_VERIFICATIONS):
        flooded.push(forged, NOW_NS, Origin("flood"))
    rows: dict[str, list[float]] = {"sign": [], "unsigned": [], "signed": [], "refused": []}
    for _ in range(arguments.repeats):
        for name, work in (
            ("sign", sign),
            ("unsigned", lambda: receive(plain, None)),
            ("signed", lambda: receive(signed, PacketVerifier(trust))),
            ("refused", refuse),
        ):
            began = time.process_time_ns()
            count = work()
            rows[name].append((time.process_time_ns() - began) / 1e3 / count)
    sign_us, unsigned_us, signed_us, refused_us = (round(statistics.median(row), 2) for row in rows.values())
    seconds = (PACKETS_PER_S * (signed_us - unsigned_us) + PACKETS_PER_S / 10 * sign_us) / 1e6
    result = Result(
        len(signed[1][0]),
        sign_us,
        unsigned_us,
        signed_us,
        refused_us,
        round(seconds, 4),
        round(3 * ENVELOPE_BYTES / 4096, 4),
    )
    content = {"study": "signatures", **asdict(result), "tables": [make_table(result)]}
    write_json(arguments.out, content, vars(arguments) | {"out": str(arguments.out.name)}, 0)
    for name, value in asdict(result).items():
        print(f"{name:28}{value:10}")


if __name__ == "__main__":
    main()
