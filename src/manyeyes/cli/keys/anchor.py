# SPDX-License-Identifier: Apache-2.0
"""Make an anchor: the key that all certificates are traced to, and a trust file that admits it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from manyeyes._bounds import CertificateDays, InputPath, OutputFolder


@dataclass(frozen=True)
class Options:
    """Name and place of the anchor."""

    out: OutputFolder = Path("keys")
    """Folder for anchor.key, which only you can read, and trust.toml, which every receiver gets."""
    name: str = "anchor"
    """Its name in the trust file."""
    days: CertificateDays = 45
    """For how long the trust file admits it."""
    passphrase_file: InputPath | None = None
    """A file with the pass phrase that encrypts the key; without it the key is not encrypted."""


def main(options: Options) -> None:
    """Write the key and the trust file."""
    from manyeyes.cli.keys.passphrase import read_passphrase
    from manyeyes.runtime.federation import make_anchor

    files = make_anchor(options.out, options.name, options.days, read_passphrase(options.passphrase_file))
    print(f"{files.key}: keep it secret, and off the machines of agents\n{files.trust}: copy it to every receiver")
