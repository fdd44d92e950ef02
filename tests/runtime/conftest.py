# SPDX-License-Identifier: Apache-2.0
"""A federation of one anchor, one issuer, and agents with certificates; tiny weights and a drive made of arithmetic."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from tests.agents.conftest import detector, drive  # noqa: F401

from manyeyes.comms.signatures.certificate import RIGHTS, SENDER_RIGHTS, Right

pytest.importorskip("cryptography", reason="the extra live is not installed")

from manyeyes.runtime.keys import Identity, Issuer, Validity, generate_key, public_bytes
from manyeyes.runtime.trust_file import Anchor, NamedCertificate, Trust

START_S = 1_800_000_000


@dataclass(frozen=True)
class Federation:
    """trust: what receivers accept. issuer: signs certificates of agents."""

    trust: Trust
    anchor: Issuer
    issuer: Issuer

    @classmethod
    def make(cls) -> Federation:
        anchor_key, issuer_key = generate_key(), generate_key()
        anchor = Issuer.of_anchor(anchor_key)
        valid = Validity(START_S - 3600, 60_000)
        certificate = anchor.issue(public_bytes(issuer_key), RIGHTS, 0, valid)
        trust = Trust(
            (Anchor("anchor", public_bytes(anchor_key), frozenset(RIGHTS), START_S + 10**7),),
            (NamedCertificate("issuer", certificate),),
        )
        return cls(trust, anchor, Issuer(issuer_key, certificate.identifier))

    def identity(
        self, agent_id: int, rights: frozenset[Right] = SENDER_RIGHTS, valid: Validity | None = None
    ) -> Identity:
        key = generate_key()
        return Identity(key, self.issuer.issue(public_bytes(key), rights, agent_id, valid or Validity(START_S - 60)))


@pytest.fixture(scope="session")
def federation() -> Federation:
    return Federation.make()
