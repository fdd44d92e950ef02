# SPDX-License-Identifier: Apache-2.0
"""Two processes that compile two variants of one function at once keep both, each under its own name."""

from __future__ import annotations

import multiprocessing
import re
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import pytest

import manyeyes
from manyeyes._jit import _LockedIndexFile, njit


class _Slow(_LockedIndexFile):
    """Between reading the index and writing it, the other process comes."""

    def _load_index(self) -> Any:
        found = super()._load_index()
        time.sleep(0.3)
        return found


def _keep(folder: Path, key: str, start: Barrier) -> None:
    index = _Slow(str(folder), "loop", "stamp")
    start.wait(20)
    index.save(key, f"the code of {key}")


@pytest.mark.slow
def test_two_processes_keep_both_variants(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(2)
    both = [context.Process(target=_keep, args=(tmp_path, key, start)) for key in ("one", "two")]
    for process in both:
        process.start()
    for process in both:
        process.join(60)
        assert process.exitcode == 0
    index = _LockedIndexFile(str(tmp_path), "loop", "stamp")
    assert [index.load(key) for key in ("one", "two", "three")] == ["the code of one", "the code of two", None]


def test_loops_are_kept_so() -> None:
    @njit(cache=True)
    def loop(n):  # pragma: no cover
        return n

    assert isinstance(loop._cache._cache_file, _LockedIndexFile)


def test_every_loop_takes_njit_from_here() -> None:
    root = Path(manyeyes.__file__).parent
    texts = {path: path.read_text() for path in root.rglob("*.py") if path.name != "_jit.py"}
    assert sum(bool(re.search(r"manyeyes\._jit import (\(\n)?[^)]*\bnjit\b", text)) for text in texts.values()) > 30
    assert not [
        path for path, text in texts.items() if re.search(r"from numba import .*njit|numba\.njit|numba\.jit", text)
    ]
