# SPDX-License-Identifier: Apache-2.0
"""Arrays that were slow to parse, kept where the next run finds them."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_write


def default_cache_folder() -> Path:
    """Return ``$MANYEYES_CACHE``, else ``manyeyes`` in the user's cache folder."""
    chosen = os.environ.get("MANYEYES_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "manyeyes"


@dataclass(frozen=True)
class ArrayCache:
    """Arrays parsed from files; an entry holds for one path, size and modification time and no other.

    A folder that cannot be written to costs speed only: the file is parsed again each time.
    """

    folder: Path

    def _entry(self, source: Path, kind: str) -> tuple[Path, str]:
        digest = hashlib.sha256(os.path.abspath(source).encode()).hexdigest()[:24]  # noqa: PTH100 - links stay as they are
        stat = source.stat()
        return self.folder / digest[:2], f"{digest}.{kind}.{stat.st_size:x}-{stat.st_mtime_ns:x}.npy"

    def load(self, source: Path, kind: str) -> np.ndarray | None:
        """Return the array that was stored for this very state of the file, or None."""
        folder, name = self._entry(source, kind)
        try:
            return np.load(folder / name, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None

    def store(self, source: Path, kind: str, array: np.ndarray) -> None:
        """Keep an array for the file as it is now, and drop those of its earlier states."""
        folder, name = self._entry(source, kind)
        data = io.BytesIO()
        np.save(data, array, allow_pickle=False)
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            atomic_write(folder / name, data.getbuffer(), durable=False)
            earlier = f"{name.split('.')[0]}.{kind}."
            # Without a pattern: a glob costs more than the parsing of a small file.
            for old in os.listdir(folder):  # noqa: PTH208
                if old.startswith(earlier) and old.endswith(".npy") and old != name:
                    (folder / old).unlink(missing_ok=True)
