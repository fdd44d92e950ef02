# SPDX-License-Identifier: Apache-2.0
"""Make a whole federation for tests: an anchor, an issuer, a trust file, and agents with certificates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from manyeyes._bounds import CertificateMinutes, OutputFolder, WorkerCount


@dataclass(frozen=True)
class Options:
    """How many agents, and where."""

    out: OutputFolder = Path("keys")
    """Folder for all keys and certificates; agents have the ids 1, 2, ..."""
    agents: WorkerCount = 5
    """Number of agents."""
    lifetime_min: CertificateMinutes = 1440
    """Minutes for which the certificates of agents are valid."""


def main(options: Options) -> None:
    """Write the keys, certificates and the trust file."""
    from manyeyes.runtime.federation import make_demo_federation

    trust = make_demo_federation(options.out, range(1, options.agents + 1), options.lifetime_min)
    print(f"{options.agents} agents in {options.out}; receivers read {trust}")
