# SPDX-License-Identifier: Apache-2.0
"""Print what a certificate states; nothing is verified."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """The certificate that is printed."""

    certificate: tyro.conf.Positional[Path]
    """A .cert file."""


def main(options: Options) -> None:
    """Print the fields of the certificate."""
    from datetime import UTC, datetime

    from manyeyes.runtime.keys import load_certificate

    found = load_certificate(options.certificate)
    times = [datetime.fromtimestamp(t, UTC).isoformat() for t in (found.not_before_s, found.not_after_s)]
    lines = {
        "signer": found.identifier.hex(),
        "agent id": found.agent_id,
        "rights": ", ".join(sorted(found.rights)),
        "valid": " to ".join(times),
        "area": "anywhere" if found.area is None else found.area,
        "public key": found.public_key.hex(),
        "issuer": found.issuer.hex(),
    }
    print("\n".join(f"{name:12}{value}" for name, value in lines.items()))
