# SPDX-License-Identifier: Apache-2.0
"""Metadata, Makefile, constraints, type checker and README name the same Python versions and the same packages."""

from __future__ import annotations

import ast
import re
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest

from manyeyes import __version__

REPOSITORY = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
VERSIONS = re.findall(r":: (3\.\d+)$", "\n".join(PROJECT["classifiers"]), re.MULTILINE)
CONSTRAINTS = (REPOSITORY / "constraints.txt").read_text()
PINS = dict(re.findall(r"^([A-Za-z0-9_-]+)==(\S+)$", CONSTRAINTS, re.MULTILINE))


def minor(version: str) -> int:
    return int(version.partition(".")[2])


def test_the_oldest_python_is_the_same_everywhere() -> None:
    oldest = min(VERSIONS, key=minor)
    assert PROJECT["requires-python"] == f">={oldest}"
    assert PYPROJECT["tool"]["ruff"]["target-version"] == f"py{oldest.replace('.', '')}"
    assert PYPROJECT["tool"]["basedpyright"]["pythonVersion"] == oldest
    makefile = (REPOSITORY / "Makefile").read_text()
    assert f"needs Python {oldest} or later" in makefile and f"sys.version_info < (3, {minor(oldest)})" in makefile
    readme = (REPOSITORY / "README.md").read_text()
    assert f"manyeyes needs Python {oldest} or later" in readme


def test_classifiers_readme_and_constraints_name_the_same_versions() -> None:
    numbers = sorted(map(minor, VERSIONS))
    assert numbers == list(range(numbers[0], numbers[-1] + 1)), "no version is left out"
    assert f"3.{numbers[0]} to 3.{numbers[-1]}" in (REPOSITORY / "README.md").read_text()
    header = " ".join(line.strip("# ") for line in CONSTRAINTS.splitlines() if line.startswith("#"))
    assert all(f"3.{number}" in header for number in numbers)


def test_citation_and_changelog_name_the_version() -> None:
    citation, changelog = ((REPOSITORY / name).read_text() for name in ("CITATION.cff", "CHANGELOG.md"))
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [__version__]
    first, *others = re.findall(r"^## (.+)$", changelog, re.MULTILINE)
    is_unreleased = first == "[Unreleased]"
    dated = others if is_unreleased else [first, *others]
    found = [re.fullmatch(r"\[(\d+)\.(\d+)\.(\d+)\] - \d{4}-\d\d-\d\d", heading) for heading in dated]
    assert found and None not in found, f"a released section is '## [VERSION] - YEAR-MONTH-DAY'; got {dated}"
    released = [tuple(map(int, match.groups())) for match in found if match]
    assert released == sorted(set(released), reverse=True)
    current = tuple(int(part) for part in __version__.split("."))
    if is_unreleased:
        assert f"\n## [Unreleased]\n\nWhat becomes version {__version__}.\n" in changelog and current > released[0]
    else:
        assert current == released[0]


def test_every_group_of_changes_stands_apart() -> None:
    lines = (REPOSITORY / "CHANGELOG.md").read_text().splitlines()
    assert [line for before, line in pairwise(lines) if line.startswith("#") and before.strip()] == []


def test_every_dependency_is_pinned_to_a_version_that_its_bound_admits() -> None:
    requirements = pytest.importorskip("packaging.requirements", reason="packaging is not installed")
    lines = [*PYPROJECT["build-system"]["requires"], *PROJECT["dependencies"]]
    lines += [line for extra in PROJECT["optional-dependencies"].values() for line in extra]
    pins = {name.lower().replace("_", "-"): version for name, version in PINS.items()}
    for requirement in map(requirements.Requirement, lines):
        if requirement.name != PROJECT["name"]:
            assert requirement.name.lower() in pins, f"{requirement.name} has no pin in constraints.txt"
            assert requirement.specifier.contains(pins[requirement.name.lower()]), requirement


def test_wheels_are_checked_for_every_set_of_extras_and_the_readme_has_commands_to_check() -> None:
    script = ast.parse((REPOSITORY / "scripts" / "wheels.py").read_text())
    (extras,) = [
        ast.literal_eval(node.value)
        for node in script.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "EXTRAS"
    ]
    assert set(extras) == {"", "sim,view", "map", "all"}
    section = (REPOSITORY / "README.md").read_text().partition("\n## Install\n")[2].partition("\n## ")[0]
    blocks = re.findall(r"^```\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 2 and all("pip install -c constraints.txt" in block for block in blocks)
