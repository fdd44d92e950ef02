# SPDX-License-Identifier: Apache-2.0
"""Several checkouts of the package in one process, so that their times are comparable.

Each checkout has its own modules, which are exchanged in ``sys.modules`` around its calls.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]


def use_own_cache() -> tempfile.TemporaryDirectory[str]:
    """Compile the loops of all checkouts in this process; call it before the package is imported, and keep the folder.

    Code that numba has cached for several checkouts may have symbols of one name.
    """
    folder = tempfile.TemporaryDirectory()
    os.environ["NUMBA_CACHE_DIR"] = folder.name
    return folder


@dataclass
class Version:
    """One checkout of the package, with its own modules, apart from the one that sets how numba compiles in this process."""

    source: Path
    modules: dict[str, ModuleType] = field(default_factory=lambda: {"manyeyes._jit": sys.modules["manyeyes._jit"]})

    @contextmanager
    def active(self) -> Iterator[None]:
        """Make this version the package ``manyeyes`` of the process."""
        others = {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] == "manyeyes"}
        sys.modules.update(self.modules)
        sys.path.insert(0, str(self.source))
        try:
            yield
        finally:
            sys.path.remove(str(self.source))
            self.modules = {
                name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] == "manyeyes"
            }
            sys.modules.update(others)


@contextmanager
def checkout(baseline: str) -> Iterator[Path]:
    """Yield the folder of a commit, or a folder itself, whose compiled loops are then kept."""
    if Path(baseline).is_dir():
        yield Path(baseline).resolve()
        return
    with tempfile.TemporaryDirectory() as name:
        code = Path(name) / "code"
        subprocess.run(["git", "worktree", "add", "--detach", str(code), baseline], check=True, cwd=ROOT)
        try:
            yield code
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(code)], check=False, cwd=ROOT)
