# SPDX-License-Identifier: Apache-2.0
"""Two processes that compile two variants of one function at once keep both, each under its own name."""

from __future__ import annotations

import multiprocessing
import pickle
import re
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numba
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


@pytest.mark.parametrize("damage", ["gone", "module", "cut", "garbage"])
def test_an_index_that_cannot_be_read_is_compiled_anew(tmp_path: Path, damage: str) -> None:
    """After an upgrade in place, an index may name classes of the code before."""
    index = _LockedIndexFile(str(tmp_path), "loop", "stamp")
    index.save("one", "its code")
    assert index.load("one") == "its code"
    path = tmp_path / "loop.nbi"
    head = pickle.dumps(numba.__version__)
    path.write_bytes(
        {
            "gone": head + b"cmanyeyes._jit\nGone\n.",
            "module": head + b"cmanyeyes.gone\nGone\n.",
            "cut": path.read_bytes()[:-5],
            "garbage": head + b"\xff\xff",
        }[damage]
    )
    assert index.load("one") is None
    index.save("one", "its new code")
    assert index.load("one") == "its new code"


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
