# SPDX-License-Identifier: Apache-2.0
"""Names of ours and of third parties: found without an import, refused with the known names."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from manyeyes.datatypes import ConfigError, registry
from manyeyes.datatypes.registry import Registry

OWN = """
from own_package import MODULES

@MODULES.register("own")
def own():
    return "own"
"""
THEIRS = """
from own_package import MODULES

@MODULES.register("theirs")
def theirs():
    return "theirs"
"""


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry[object]]:
    """A registry whose package holds one module, and four entry points of third parties."""
    package = tmp_path / "own_package"
    package.mkdir()
    (package / "__init__.py").write_text(
        'from manyeyes.datatypes.registry import Registry\nMODULES = Registry("method", "own.method", __name__)\n'
    )
    (package / "own.py").write_text(OWN)
    (package / "_helper.py").write_text("raise RuntimeError('a private module is not imported')\n")
    (tmp_path / "their_module.py").write_text(THEIRS)
    (tmp_path / "broken_module.py").write_text("import a_module_that_is_not_installed\n")
    (tmp_path / "empty_module.py").write_text("ITEM = 'item'\n")
    points = [
        EntryPoint("theirs", "their_module", "own.method"),
        EntryPoint("broken", "broken_module", "own.method"),
        EntryPoint("empty", "empty_module", "own.method"),
        EntryPoint("item", "empty_module:ITEM", "own.method"),
    ]
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(registry, "entry_points", lambda group: [p for p in points if p.group == group])
    import own_package  # pyright: ignore[reportMissingImports]

    yield own_package.MODULES
    for name in ("own_package", "own_package.own", "their_module", "broken_module", "empty_module"):
        sys.modules.pop(name, None)


def test_names_are_listed_without_an_import_of_third_parties(modules: Registry[object]) -> None:
    assert modules.names() == ("own", "broken", "empty", "item", "theirs")
    assert "theirs" in modules and "nothing" not in modules
    assert "their_module" not in sys.modules


def test_own_and_third_party_items_are_found_by_name(modules: Registry[object]) -> None:
    assert modules.get("own")() == "own"  # pyright: ignore[reportCallIssue]
    assert modules.get("theirs")() == "theirs"  # pyright: ignore[reportCallIssue]


def test_an_unknown_name_lists_the_known_ones(modules: Registry[object]) -> None:
    with pytest.raises(ConfigError, match=r"No method is called 'nothing'; known: own, broken, empty, item, theirs."):
        modules.get("nothing")


def test_a_third_party_that_cannot_be_imported_breaks_only_its_own_name(modules: Registry[object]) -> None:
    with pytest.raises(ConfigError, match=r"'broken' .* cannot be imported: ModuleNotFoundError"):
        modules.get("broken")
    with pytest.raises(ConfigError, match=r"'empty' .* registers no method of that name"):
        modules.get("empty")
    with pytest.raises(ConfigError, match=r"'item' .* empty_module:ITEM, which registers no method"):
        modules.get("item")
    assert modules.get("theirs")


def test_a_name_is_given_once(modules: Registry[object]) -> None:
    modules.get("own")
    with pytest.raises(ConfigError, match=r"A method called 'own' is registered already, by own_package.own"):
        modules.register("own")(lambda: "other")
