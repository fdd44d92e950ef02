# SPDX-License-Identifier: Apache-2.0
"""What the package imports is what its metadata install: core dependencies, and for each feature its extra."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCE = REPOSITORY / "src" / "manyeyes"
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
MODULES = {
    "PIL": "pillow",
    "yaml": "pyyaml",
    "sumo": "eclipse-sumo",
    "small_gicp": "small-gicp",
    "zenoh": "eclipse-zenoh",
    "llvmlite": "numba",
    "prometheus_client": "prometheus-client",
    "rerun": "rerun-sdk",
}
"""Modules whose package on the index has another name; numba brings llvmlite of its own version."""


def packages(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=;]", line)[0].strip().lower() for line in requirements}


CORE = packages(PROJECT["dependencies"])
GROUPS = ("all", "dev", "docs")
"""Extras of no feature: sets of others, and tools of a checkout."""
EXTRAS = {name: packages(lines) for name, lines in PROJECT["optional-dependencies"].items() if name not in GROUPS}


def imported(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Top-level modules that are imported at run time, also by name, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            node.body = []
        elif isinstance(node, ast.Import):
            yield from ((alias.name.split(".")[0], node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module).split(".")[0], node.lineno
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module" and node.args:
            name = node.args[0]
            if isinstance(name, ast.Constant):
                yield str(name.value).split(".")[0], node.lineno


def third_party() -> list[tuple[str, str, ast.Module]]:
    found = []
    for path in sorted(SOURCE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        for module, line in imported(tree):
            if module not in sys.stdlib_module_names and module not in ("manyeyes", "__future__"):
                found.append((MODULES.get(module, module), f"{path.relative_to(SOURCE)}:{line}", tree))
    return found


def named_extras(tree: ast.Module) -> set[str]:
    """The extras that a file names where a package is not there: by MissingExtraError, or by import_extra at once or later."""
    positions = {"MissingExtraError": 0, "import_extra": 1}
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
    named = [(getattr(call.func, "id", ""), call.args) for call in calls]
    named += [(getattr(args[0], "id", ""), args[1:]) for name, args in named if name == "partial"]
    values = [args[positions[name]] for name, args in named if name in positions]
    return {str(value.value) for value in values if isinstance(value, ast.Constant)}


@pytest.mark.slow
def test_every_import_is_of_a_core_dependency_or_of_an_extra() -> None:
    known = CORE.union(*EXTRAS.values())
    assert [(package, place) for package, place, _ in third_party() if package.lower() not in known] == []


@pytest.mark.slow
def test_a_file_that_names_an_extra_imports_nothing_that_this_extra_lacks() -> None:
    lacking = []
    for package, place, tree in third_party():
        for extra in named_extras(tree):
            # One file may offer features of several extras: what it imports lies in one of them.
            if package.lower() not in CORE.union(*(EXTRAS[name] for name in named_extras(tree))):
                lacking.append((extra, package, place))
    assert lacking == []


def test_the_extra_all_holds_every_extra() -> None:
    (line,) = PROJECT["optional-dependencies"]["all"]
    held = re.fullmatch(r"manyeyes\[([a-z0-9,]+)\]", line)
    assert held is not None and set(held[1].split(",")) == set(EXTRAS)


def test_the_compiled_linear_algebra_finds_its_library() -> None:
    assert "scipy" in CORE


def test_the_install_line_of_the_readme_holds_what_the_demo_imports() -> None:
    """The demo makes scenes (SUMO, shapely), writes a map (pyarrow) and draws (pillow, matplotlib)."""
    install = re.search(r"pip install .*\[([a-z,0-9]+)\]'", (REPOSITORY / "README.md").read_text())
    assert install is not None
    held = CORE.union(*(EXTRAS[name] for name in install[1].split(",")))
    assert {"eclipse-sumo", "libsumo", "shapely", "pyarrow", "pillow", "matplotlib"} <= held


def test_doctor_looks_for_what_the_extras_install(capsys: pytest.CaptureFixture[str]) -> None:
    from manyeyes.cli import main as cli
    from manyeyes.cli.requirements import EXTRAS as LOOKED_FOR

    wanted = {name: {MODULES.get(m, m).lower() for m in modules} for name, modules in LOOKED_FOR.items()}
    assert wanted == EXTRAS
    assert cli.main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {entry["name"] for entry in report["extras"]} == set(EXTRAS)


@pytest.mark.slow
def test_the_package_imports_no_extra_before_it_is_needed() -> None:
    code = (
        "import sys, manyeyes.cli.main, manyeyes.agents.agent, manyeyes.cli.view, manyeyes.studies.spatial_views; "
        "import manyeyes.viz.rerun_log, manyeyes.viz.foxglove_log; "
        "optional = 'shapely pyarrow PIL matplotlib libsumo cryptography zenoh mcap rerun rerun_cli'.split(); "
        "sys.exit(any(m in sys.modules for m in optional))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
