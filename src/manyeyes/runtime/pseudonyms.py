# SPDX-License-Identifier: Apache-2.0
"""Change of pseudonyms: an agent sends under one certificate, is silent for a while, and goes on under another.

Agent id, signer and keys of the network change together, so that receivers begin a new history. No trust outlasts a pseudonym.
Positions and driving style still link pseudonyms: this is no anonymity.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_uniform
from manyeyes.runtime.keys import KEY_SUFFIX, Identity

NS_PER_S = 1_000_000_000
CHANGE_PERIOD_NS = 900 * NS_PER_S
"""Time for which an identity is used."""
SILENCE_NS = (3 * NS_PER_S, 13 * NS_PER_S)
"""Bounds of the silent period between two identities; its length is uniform."""


class PseudonymPool:
    """The identities of one agent, used in turn from the time of the first call. A single identity never changes.

    seed: of the lengths of silent periods.
    """

    def __init__(self, identities: Sequence[Identity], seed: int = 0, period_ns: int = CHANGE_PERIOD_NS) -> None:
        if not identities:
            raise ConfigError("A pool of pseudonyms has at least one identity; manyeyes keys pool makes one.")
        self._identities, self._seed, self._period_ns = tuple(identities), seed, period_ns
        self._number, self._begin_ns, self._resume_ns = 0, None, None

    _begin_ns: int | None
    _resume_ns: int | None

    @classmethod
    def load(cls, path: Path, passphrase: bytes | None = None, seed: int = 0) -> PseudonymPool:
        """Read one key file, or all key files of a folder, with the certificates beside them.

        Raises:
            ConfigError: the folder holds no key.
        """
        files = sorted(path.glob(f"*{KEY_SUFFIX}")) if path.is_dir() else [path]
        if not files:
            raise ConfigError(f"{path}: no {KEY_SUFFIX} file in this folder; manyeyes keys pool makes some.")
        return cls([Identity.load(file, passphrase) for file in files], seed)

    def identity(self, now_ns: int) -> Identity | None:
        """Return the identity at a time, None in a silent period; times do not decrease."""
        if self._begin_ns is None:
            self._begin_ns = now_ns
        if self._resume_ns is not None:
            if now_ns < self._resume_ns:
                return None
            self._begin_ns, self._resume_ns = now_ns, None
            self._number += 1
        elif len(self._identities) > 1 and now_ns - self._begin_ns >= self._period_ns:
            shortest, longest = SILENCE_NS
            draw = float(keyed_uniform((1,), self._seed, "pseudonym", self._number)[0])
            self._resume_ns = now_ns + shortest + round(draw * (longest - shortest))
            return None
        return self._identities[self._number % len(self._identities)]
