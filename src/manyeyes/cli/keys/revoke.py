# SPDX-License-Identifier: Apache-2.0
"""Revoke a certificate in a trust file; receivers that run read it again within a second."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """Which certificate, in which trust file."""

    certificate: tyro.conf.Positional[Path]
    """A .cert file, of an agent or of an issuer."""
    trust: Path = Path("keys/trust.toml")
    """The trust file; copy it to every receiver."""


def main(options: Options) -> None:
    """Add the certificate to the list."""
    from manyeyes.runtime.federation import revoke
    from manyeyes.runtime.keys import load_certificate

    certificate = load_certificate(options.certificate)
    revoked = revoke(options.trust, certificate).revoked
    print(f"{options.trust}: {len(revoked.signers)} agents and {len(revoked.issuers)} issuers are revoked")
