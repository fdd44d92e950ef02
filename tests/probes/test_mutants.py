# SPDX-License-Identifier: Apache-2.0
"""The mutation tool: what it changes and leaves, the draw, the mapping to test files, and one run on a small repository."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

FOLDER = Path(__file__).parent
SOURCE = b'''"""A docstring of 1 + 1."""
from __future__ import annotations

from typing import TYPE_CHECKING

from numba import njit

if TYPE_CHECKING:
    LIMIT = 3
__all__ = ["clamp"]


@njit(cache=True)
def clamp(x: int | None, low: int = 2) -> int:
    """Not less than 2."""
    if not x:
        raise ValueError(f"expected more than {0 + 1}; got {x}" + str(3))
    print(7)
    y = max(x, low)
    y += 1
    for _ in zip([y], [x], strict=True):
        y = -y + 0.5
    return y if y < 4 and low else None
'''


@pytest.fixture(scope="module")
def tool():
    sys.path.insert(0, str(FOLDER))
    try:
        yield importlib.import_module("mutants")
    finally:
        sys.path.remove(str(FOLDER))
        for name in ("mutants", "mutations"):
            sys.modules.pop(name, None)


def changed_lines(tool, source: bytes) -> dict[str, set[str]]:
    """The mutated lines by the original line, without indentation."""
    lines: dict[str, set[str]] = {}
    for mutation in tool.find_mutations("src/manyeyes/a.py", source):
        old, new = (line[1:].strip() for line in mutation.diff(source).splitlines()[1:])
        lines.setdefault(old, set()).add(new)
    return lines


def test_mutations_of_each_line(tool) -> None:
    assert changed_lines(tool, SOURCE) == {
        "def clamp(x: int | None, low: int = 2) -> int:": {
            "def clamp(x: int | None, low: int = 3) -> int:",
            "def clamp(x: int | None, low: int = 1) -> int:",
        },
        "if not x:": {"if (x):"},
        "y = max(x, low)": {"y = min(x, low)"},
        "y += 1": {"pass", "y += 2", "y += 0"},
        "y = -y + 0.5": {"pass", "y = (-y - 0.5)", "y = (y) + 0.5", "y = -y + 1.0"},
        "return y if y < 4 and low else None": {
            "return None",
            "return y if (not (y < 4 and low)) else None",
            "return y if (y < 4 or low) else None",
            "return y if (y <= 4) and low else None",
            "return y if (y >= 4) and low else None",
            "return y if y < 5 and low else None",
            "return y if y < 3 and low else None",
        },
    }


def test_every_mutation_changes_the_program_and_compiles(tool) -> None:
    source = (tool.ROOT / "src" / "manyeyes" / "comms" / "bandwidth.py").read_bytes()
    original = ast.dump(ast.parse(source))
    mutants = [ast.dump(ast.parse(m.apply(source))) for m in tool.find_mutations("bandwidth.py", source)]
    assert len(mutants) > 5 and original not in mutants


def test_what_would_change_nothing_is_not_mutated(tool) -> None:
    assert tool.find_mutations("src/manyeyes/viz/a.py", b"x = 3\ny = 2.5\n") == []
    assert changed_lines(tool, b"x = sum(-1)\n") == {"x = sum(-1)": {"x = sum(-0)"}}
    assert changed_lines(tool, b"def f(): return False\n") == {"def f(): return False": {"def f(): return True"}}
    assert changed_lines(tool, b"x = sum(0)\n") == {"x = sum(0)": {"x = sum(1)"}}


def test_the_draw_follows_its_seed_and_the_size_of_modules(tool) -> None:
    large, small = b"".join(b"a%d = %d\n" % (n, n) for n in range(300)), b"b = 1\nc = 2\nd = 3\n"
    sources = {"src/large.py": large, "src/small.py": small}
    drawn = tool.draw_mutations(sources, 100, 5)
    assert drawn == tool.draw_mutations(dict(reversed(sources.items())), 100, 5)
    assert drawn != tool.draw_mutations(sources, 100, 6)
    assert len(set(drawn)) == 100
    assert sum(m.path == "src/large.py" for m in drawn) > 90
    assert len(tool.draw_mutations({"src/small.py": small}, 100, 5)) == 6


def test_changes_elsewhere_leave_most_of_a_draw(tool) -> None:
    text = b"".join(b"a%d = %d\n" % (n, n) for n in range(300))
    before = tool.draw_mutations({"src/a.py": text, "src/b.py": text}, 40, 5)
    after = tool.draw_mutations({"src/a.py": b"x = 7\n" + text, "src/b.py": text, "src/c.py": b"y = 8\n"}, 40, 5)
    same = {(m.path, m.replacement) for m in before} & {(m.path, m.replacement) for m in after}
    assert len(same) >= 36


def test_tests_are_ranked_by_name_then_by_imports(tool) -> None:
    sources = {
        "src/manyeyes/__init__.py": b"",
        "src/manyeyes/maps/__init__.py": b"if TYPE_CHECKING:\n    from manyeyes.maps.graph import Graph as Graph\n",
        "src/manyeyes/maps/graph.py": b"",
        "src/manyeyes/maps/store.py": b"from manyeyes.maps.graph import Graph\n",
        "src/manyeyes/maps/_loops.py": b"",
        "src/manyeyes/cli/main.py": b'COMMANDS = {"map": ["show-all"]}\n',
        "src/manyeyes/cli/map/show_all.py": b"import manyeyes.maps.store\n",
    }
    tests = {
        "tests/a/test_public.py": b"from manyeyes.maps import Graph\n",
        "tests/a/test_store.py": b"from manyeyes.maps.store import Store\n",
        "tests/a/test_map_graph.py": b"from manyeyes.maps import store\n",
        "tests/a/test_main.py": b"from manyeyes.cli.main import main\n",
        "tests/a/test_other.py": b"import numpy\nfrom manyeyes.maps import _loops\n",
    }
    graph = tool.ImportGraph(sources, tests)
    assert [Path(path).stem for path in graph.rank_tests("manyeyes.maps.graph")] == [
        "test_map_graph",
        "test_public",
        "test_store",
        "test_main",
    ]
    assert graph.rank_tests("manyeyes.cli.map.show_all") == ["tests/a/test_main.py"]
    assert graph.rank_tests("manyeyes.maps._loops") == ["tests/a/test_other.py"]


@pytest.mark.slow
def test_every_module_has_a_test(tool) -> None:
    graph = tool.ImportGraph(tool.read_sources("src/**/*.py"), tool.read_sources("tests/**/test_*.py"))
    modules = [tool.module_name(path) for path in tool.read_sources("src/**/*.py") if not path.endswith("__init__.py")]
    assert [module for module in modules if not graph.rank_tests(module)] == []


@pytest.mark.slow
def test_a_run_kills_detected_mutants_and_lists_the_others(tool, tmp_path: Path) -> None:
    root, work = tmp_path / "root", tmp_path / "work"
    for name, text in {
        "src/manyeyes/__init__.py": "",
        "src/manyeyes/bound.py": "def is_free(x: int) -> bool:\n    return x < 5\n",
        "tests/test_bound.py": """
            from manyeyes.bound import is_free
            def test_broken(): assert False
            def test_is_free(): assert is_free(4) and not is_free(6)
        """,
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(dedent(text))
    subprocess.run(["git", "init", "--quiet"], cwd=root, check=True)
    copy, path = tool.Copy(root, work, 60.0), "src/manyeyes/bound.py"
    mutations = {m.replacement: m for m in tool.find_mutations(path, (root / path).read_bytes())}
    graph = tool.ImportGraph({path: b""}, {"tests/test_bound.py": b"import manyeyes.bound"})
    outcomes = list(tool.run_mutants(copy, [mutations["(x <= 5)"], mutations["4"]], graph, 3))
    broken, detecting = "tests/test_bound.py::test_broken", "tests/test_bound.py::test_is_free"
    assert [outcome.killer for outcome in outcomes] == [broken, broken, "", detecting]
    assert copy.failing == {broken}
    assert (work / path).read_text() == (root / path).read_text()
