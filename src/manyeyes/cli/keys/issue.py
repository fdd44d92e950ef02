# SPDX-License-Identifier: Apache-2.0
"""Issue a certificate: of an agent, or of an issuer, which an anchor signs and which then signs those of agents."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from manyeyes._bounds import AgentId, CertificateDays, CertificateMinutes, InputPath

RightOption = Literal["objects", "tokens", "points", "map", "infrastructure"]


@dataclass(frozen=True)
class Options:
    """The issuer, and the certificate that it issues."""

    stem: tyro.conf.Positional[Path]
    """Stem of the files: NAME.key and NAME.cert are written."""
    issuer: Path = Path("keys/anchor.key")
    """The key that signs: that of an anchor, or of an issuer with its certificate beside it."""
    kind: Literal["agent", "issuer"] = "agent"
    """An issuer is added to the trust file, too."""
    agent_id: AgentId = 0
    """Id of the agent in its messages."""
    rights: tuple[RightOption, ...] = ("objects", "tokens", "points", "map")
    """What the agent may send; infrastructure: as a roadside unit."""
    lifetime_min: CertificateMinutes = 60
    """Minutes for which the certificate of an agent is valid; short, since only listed certificates are revoked."""
    days: CertificateDays = 7
    """Days for which the certificate of an issuer is valid."""
    trust: Path | None = None
    """The trust file that gets an issuer; by default trust.toml beside the anchor's key."""
    passphrase_file: InputPath | None = None
    """A file with the pass phrase of the issuer's key, which encrypts the new key too."""


def main(options: Options) -> None:
    """Write a key and its certificate."""
    from manyeyes.cli.keys.passphrase import read_passphrase
    from manyeyes.runtime.federation import TRUST_FILE, load_issuer, make_agent, make_issuer

    passphrase = read_passphrase(options.passphrase_file)
    if options.kind == "issuer":
        trust = options.trust or options.issuer.with_name(TRUST_FILE)
        made = make_issuer(options.stem, options.issuer, trust, options.days, passphrase)
        print(f"issuer {made.certificate.identifier.hex()} is in {trust}; copy it to every receiver")
        return
    issuer = load_issuer(options.issuer, passphrase)
    made = make_agent(options.stem, issuer, options.agent_id, options.rights, options.lifetime_min, passphrase)
    print(f"agent {made.agent_id}, signer {made.certificate.identifier.hex()}: {options.stem}.key, {options.stem}.cert")
