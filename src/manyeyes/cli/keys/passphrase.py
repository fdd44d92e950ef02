# SPDX-License-Identifier: Apache-2.0
"""Pass phrases of keys come from files: an argument would be seen by every user of the machine."""

from __future__ import annotations

from pathlib import Path


def read_passphrase(path: Path | None) -> bytes | None:
    """Return the first line of a file; None without a file, or where it is empty."""
    from manyeyes._io import read_file

    return None if path is None else read_file(path, 4096).partition(b"\n")[0].rstrip(b"\r") or None
