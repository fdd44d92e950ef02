# SPDX-License-Identifier: Apache-2.0
"""Issue a pool of pseudonyms of one agent: certificates with random agent ids that it uses in turn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from manyeyes._bounds import CertificateMinutes, InputPath, OutputFolder, WorkerCount


@dataclass(frozen=True)
class Options:
    """Who issues how many."""

    out: OutputFolder
    """Folder for the keys and certificates."""
    issuer: Path = Path("keys/issuer.key")
    """The key that signs, with its certificate beside it."""
    count: WorkerCount = 20
    """Number of pseudonyms."""
    lifetime_min: CertificateMinutes = 1440
    """Minutes for which each certificate is valid, from now on."""
    passphrase_file: InputPath | None = None
    """A file with the pass phrase of the issuer's key, which encrypts the new keys too."""


def main(options: Options) -> None:
    """Write the keys and certificates."""
    from manyeyes.cli.keys.passphrase import read_passphrase
    from manyeyes.runtime.federation import load_issuer, make_pool

    passphrase = read_passphrase(options.passphrase_file)
    made = make_pool(
        options.out, load_issuer(options.issuer, passphrase), options.count, options.lifetime_min, passphrase
    )
    print(f"{len(made)} pseudonyms in {options.out}")
