# SPDX-License-Identifier: Apache-2.0
"""Print the anchors, issuers and revocations of a trust file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """The trust file that is printed."""

    trust: tyro.conf.Positional[Path]
    """A trust.toml of 'manyeyes keys anchor'."""


def main(options: Options) -> None:
    """Print the content of the file."""
    from manyeyes.runtime.trust_file import Trust

    trust = Trust.load(options.trust)
    admitted = trust.grantors()
    for anchor in trust.anchors:
        print(f"anchor  {anchor.identifier.hex()}  {anchor.name}  {', '.join(sorted(anchor.rights))}")
    for issuer in trust.issuers:
        identifier = issuer.certificate.identifier
        note = "" if identifier in admitted else "  NOT ADMITTED: no anchor has signed it, or it is revoked"
        print(f"issuer  {identifier.hex()}  {issuer.name}{note}")
    for kind, identifiers in (("agent", trust.revoked.signers), ("issuer", trust.revoked.issuers)):
        for identifier in sorted(identifiers):
            print(f"revoked {identifier.hex()}  {kind}")
