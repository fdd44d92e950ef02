# SPDX-License-Identifier: Apache-2.0
"""Compiled loops: two processes that compile variants of one at once keep both; what a loop calls is linked into it.

Garbage is not collected meanwhile, and loops run where no folder can be written.
"""

from __future__ import annotations

import gc
import json
import multiprocessing
import pickle
import re
import subprocess
import sys
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import caching, event

import manyeyes
from manyeyes._jit import (
    _describe,
    _LinkedCompiler,
    _LockedIndexFile,
    add_row,
    find_cache_folder,
    njit,
    set_row,
    set_rows,
)

_BLOCK = """
        for i in range(x.shape[0]):
            for j in range(i, x.shape[0]):
                if (i + j) % {k} == 1:
                    total += factor * x[i] * x[j]
                else:
                    total -= x[j]
"""
# Too long a closure for LLVM to copy it into its callers.
_CLOSURES = f"""
from manyeyes._jit import njit

def make(factor):
    @njit(cache=True)
    def add(x):
        total = 0.0
{"".join(_BLOCK.format(k=k) for k in range(3, 23))}
        return total
    return add

one, two = make(1.0), make(2.0)

@njit(cache=True)
def sum_once(x):
    return one(x) + one(x[1:]) + one(x[2:])

@njit(cache=True)
def sum_twice(x):
    return two(x) + two(x[1:]) + two(x[2:])
"""


@pytest.mark.slow
def test_closures_that_two_processes_compiled_stay_apart(tmp_path: Path) -> None:
    (tmp_path / "loops.py").write_text(_CLOSURES)

    def call(*names: str) -> list[float]:
        calls = ", ".join(f"loops.{name}(np.ones(9))" for name in names)
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numpy as np, loops; print([{calls}])"
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
        return json.loads(run.stdout)

    # Each process compiles one caller, and its closure has the same number among the functions that it compiles.
    once, twice = call("sum_once") + call("sum_twice")
    assert once != twice and len(list((tmp_path / "__pycache__").glob("loops.sum_*.nbi"))) == 2, "both were kept"
    assert call("sum_once", "sum_twice") == [once, twice]
    assert call("sum_twice", "sum_once") == [twice, once]


def test_functions_are_described_by_content() -> None:
    def make(factor: Any) -> Any:
        def scale(x: float) -> float:
            return factor * x

        return scale

    def refer() -> Any:
        def fall(x: int) -> int:
            return fall(x - 1) if x else 0

        return fall

    assert _describe(make(1.0)) == _describe(make(1.0)) != _describe(make(2.0))
    assert _describe(make(njit()(len_of))) == _describe(make(len_of)) != _describe(make(make))
    assert _describe(make([])) != _describe(make([])), "unknown values are themselves alone"
    assert "recursion" in repr(_describe(refer()))


def len_of(x: Any) -> int:
    return len(x)


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


def test_a_loop_called_by_loops_has_no_code_of_its_own_until_python_calls_it() -> None:
    @njit()
    def square(x):  # pragma: no cover
        if x < 0:
            raise ValueError("below zero")
        return x * x

    @njit()
    def sum_squares(values):  # pragma: no cover
        total = 0.0
        for i in range(len(values)):
            total += square(values[i])
        return total

    assert sum_squares(np.array([1.0, 2.0, 3.0])) == 14.0
    assert not square.overloads and len(sum_squares.overloads) == 1
    with pytest.raises(ValueError, match="below zero"):
        sum_squares(np.array([-1.0]))
    assert square(4.0) == 16.0 and len(square.overloads) == 1
    assert sum_squares(np.array([5.0])) == 25.0
    assert sum_squares(np.array([5.0], np.float32)) == 25.0


class _Compilations(event.Listener):
    """The compiler of each loop that is compiled, by its name, and whether garbage was collected meanwhile."""

    def __init__(self) -> None:
        self.compilers: dict[str, type] = {}
        self.is_collecting: list[bool] = []

    def on_start(self, event: event.Event) -> None:
        dispatcher = event.data["dispatcher"]
        self.compilers[dispatcher.py_func.__qualname__] = dispatcher._compiler.pipeline_class
        self.is_collecting.append(gc.isenabled())

    def on_end(self, event: event.Event) -> None:
        pass


def test_functions_of_numpy_are_linked_too() -> None:
    @njit()
    def rotate(values, turns):  # pragma: no cover
        return np.roll(values, turns)

    with event.install_listener("numba:compile", _Compilations()) as found:
        assert rotate(np.array([1.0, 2.0, 3.0]), 1).tolist() == [3.0, 1.0, 2.0]
    inner = {compiler for name, compiler in found.compilers.items() if "rotate" not in name}
    assert inner == {_LinkedCompiler}


def test_garbage_is_not_collected_while_a_loop_is_compiled() -> None:
    @njit()
    def double(x):  # pragma: no cover
        return 2 * x

    with event.install_listener("numba:compile", _Compilations()) as found:
        assert double(2.0) == 4.0
        assert found.is_collecting == [False] and gc.isenabled()
        gc.disable()
        try:
            assert double(2) == 4 and not gc.isenabled()
        finally:
            gc.enable()


def test_loops_run_where_no_folder_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])

    @njit(cache=True)
    def triple(x):  # pragma: no cover
        return 3 * x

    assert triple(2) == 6
    assert find_cache_folder() is not None
    monkeypatch.setattr(set_row, "_cache", triple._cache)
    assert find_cache_folder() is None


def test_a_loop_has_one_form_for_all_constants_of_a_type() -> None:
    @njit()
    def scale(x, factor, is_negative):  # pragma: no cover
        return -factor * x if is_negative else factor * x

    @njit()
    def sum_scaled(x, factor):  # pragma: no cover
        return scale(x, 2, False) + scale(x, 3, is_negative=True) + scale(x, factor, False)

    assert sum_scaled(2.0, 5) == 8.0
    assert len(scale._linked.overloads) == 1


def test_loops_call_themselves_and_one_another() -> None:
    @njit()
    def factorial(n):  # pragma: no cover
        return 1 if n < 2 else n * factorial(n - 1)

    @njit()
    def binomial(n, k):  # pragma: no cover
        return factorial(n) // (factorial(k) * factorial(n - k))

    assert factorial(5) == 120
    assert binomial(5, 2) == 10


_TWO_LOOPS = """
import sys
sys.path.insert(0, sys.argv[1])
from two_loops import outer
print(outer(3.0), sum(outer.stats.cache_hits.values()), sum(outer.stats.cache_misses.values()))
"""
_MODULE = """
from manyeyes._jit import njit

@njit(cache=True)
def inner(x):
    return x + 1.0

@njit(cache=True)
def outer(x):
    return 2.0 * inner(x)
"""


@pytest.mark.slow
def test_a_later_process_takes_the_whole_loop_from_the_disk(tmp_path: Path) -> None:
    (tmp_path / "two_loops.py").write_text(_MODULE)
    command = [sys.executable, "-c", _TWO_LOOPS, str(tmp_path)]
    outputs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() for _ in range(2)]
    assert outputs == [["8.0", "0", "1"], ["8.0", "1", "0"]]
    assert not [path.name for path in tmp_path.rglob("*.nbc") if "inner" in path.name]


def test_rows_are_set_and_added() -> None:
    out = np.zeros((2, 3), np.float32)
    set_row(out[1], np.array([1.0, 2.0, 3.0], np.float32))
    assert out.tolist() == [[0, 0, 0], [1, 2, 3]]
    add_row(out[1], np.array([0.5, 0.5, 0.5], np.float32))
    assert out.tolist() == [[0, 0, 0], [1.5, 2.5, 3.5]]
    set_rows(out, np.arange(6.0, dtype=np.float32).reshape(2, 3))
    assert out.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_every_loop_takes_njit_from_here() -> None:
    root = Path(manyeyes.__file__).parent
    texts = {path: path.read_text() for path in root.rglob("*.py") if path.name != "_jit.py"}
    assert sum(bool(re.search(r"manyeyes\._jit import (\(\n)?[^)]*\bnjit\b", text)) for text in texts.values()) > 30
    assert not [
        path for path, text in texts.items() if re.search(r"from numba import .*njit|numba\.njit|numba\.jit", text)
    ]
