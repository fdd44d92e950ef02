# SPDX-License-Identifier: Apache-2.0
"""Verify that a trust file admits a certificate now; the exit code is 1 where it does not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Options:
    """Which certificate, by which trust file."""

    certificate: tyro.conf.Positional[Path]
    """A .cert file."""
    trust: Path = Path("keys/trust.toml")
    """The trust file of a receiver."""


def main(options: Options) -> None:
    """Verify the certificate.

    Raises:
        KeyFileError: the trust file does not admit it; the text gives the reason.
    """
    import time

    from manyeyes.runtime.federation import find_fault
    from manyeyes.runtime.keys import KeyFileError, load_certificate
    from manyeyes.runtime.trust_file import Trust

    certificate = load_certificate(options.certificate)
    fault = find_fault(certificate, Trust.load(options.trust), time.time())
    if fault is not None:
        raise KeyFileError(f"{options.certificate}: {fault}; a receiver with {options.trust} refuses its packets.")
    print(f"{options.certificate}: admitted by {options.trust}")
