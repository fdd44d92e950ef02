# SPDX-License-Identifier: Apache-2.0
"""Security of a live agent: its identity, the senders that it accepts, and a trust file that is read again when it changes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from manyeyes.datatypes import ConfigError
from manyeyes.runtime.authentication import PacketVerifier, SecurityMode
from manyeyes.runtime.clock import TAI_UTC_NS
from manyeyes.runtime.pseudonyms import PseudonymPool
from manyeyes.runtime.trust_file import Trust, TrustFileError

CHECK_PERIOD_NS = 500_000_000


@dataclass(frozen=True)
class Security:
    """mode: as in ``runtime.authentication``. pool: identities that sign; None sends unsigned packets. trust_file: of receivers.

    Raises:
        ConfigError: a mode but off without a trust file.
    """

    mode: SecurityMode = "off"
    pool: PseudonymPool | None = None
    trust_file: Path | None = None

    def __post_init__(self) -> None:
        if self.mode != "off" and self.trust_file is None:
            raise ConfigError(f"Security {self.mode!r} needs a trust file; manyeyes keys demo makes one for tests.")
        if self.mode == "off" and self.pool is not None:
            raise ConfigError("Security 'off' signs nothing; leave the key out, or choose warn or require.")

    def make_verifier(self) -> PacketVerifier | None:
        """Return the authenticator of received packets; None in mode off."""
        if self.mode == "off" or self.trust_file is None:
            return None
        return PacketVerifier(Trust.load(self.trust_file), self.mode, utc_offset_ns=-TAI_UTC_NS)


class TrustWatcher:
    """Reads a trust file again when it changes; one that cannot be used is reported, and the last usable one stays."""

    def __init__(self, path: Path) -> None:
        self._path, self._next_ns = path, 0
        self._seen = self._stamp()
        self.error: str | None = None

    def poll(self, now_ns: int) -> Trust | None:
        """Return the new trust file, if there is one; the disk is read twice a second."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + CHECK_PERIOD_NS
        stamp = self._stamp()
        if stamp == self._seen or stamp is None:
            return None
        self._seen = stamp
        try:
            found = Trust.load(self._path)
        except (OSError, TrustFileError) as error:
            self.error = str(error)
            return None
        self.error = None
        return found

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            status = self._path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_ino, status.st_size
