# SPDX-License-Identifier: Apache-2.0
"""What is compiled ahead is all that the demo runs; where nothing can be kept, nothing is compiled.

.ci/wheel states the same of a fresh installation: after 'doctor --compile' the demo writes no loop.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")

from manyeyes.cli import compile_ahead
from manyeyes.cli.compile_ahead import CompiledAhead

# In a process of its own: other tests call loops with other types of arguments.
_DEMO_AFTER_COMPILING = """
import gc, sys
from dataclasses import replace
from pathlib import Path
from manyeyes._jit import _CompiledLoop
from manyeyes.cli import main as cli
from manyeyes.cli.compile_ahead import compile_drive
from manyeyes.simulator.presets import SIMULATION_PRESETS as presets

def list_variants():
    loops = [found for found in gc.get_objects() if isinstance(found, _CompiledLoop)]
    return {(loop.py_func.__qualname__, str(types)) for loop in loops for types in loop.overloads}

out = Path(sys.argv[1])
compile_drive(out / "ahead")
presets["demo"] = replace(presets["demo"], frames=14)
before = list_variants()
assert cli.main(["demo", "--out", str(out / "demo"), "--seed", "1", "--no-animate"]) == 0
print(len(before), sorted(list_variants() - before))
"""


@pytest.mark.slow
def test_the_demo_needs_no_other_loop(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _DEMO_AFTER_COMPILING, str(tmp_path)]
    last = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1]
    num_before, missing = last.split(" ", 1)
    assert int(num_before) > 50 and missing == "[]"


def _write_name(out: Path) -> None:
    (out / "part").touch()


def _fail(out: Path) -> None:
    raise ZeroDivisionError("a part that fails")


def test_nothing_is_compiled_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compile_ahead, "find_cache_folder", lambda: None)
    monkeypatch.setattr(compile_ahead, "compile_drive", _fail)
    assert compile_ahead.compile_ahead(lambda count: None) is None


@pytest.mark.slow
def test_parts_run_beside_each_other_and_the_error_of_one_reaches_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("compile_drive", "compile_map"):
        monkeypatch.setattr(compile_ahead, name, _write_name)
    counts: list[int] = []
    compiled = compile_ahead.compile_ahead(counts.append)
    assert isinstance(compiled, CompiledAhead) and compiled.num_loops == 0 and set(counts) <= {0}
    monkeypatch.setattr(compile_ahead, "compile_map", _fail)
    with pytest.raises(ZeroDivisionError, match="a part that fails"):
        compile_ahead.compile_ahead(counts.append)
