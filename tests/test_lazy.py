# SPDX-License-Identifier: Apache-2.0
"""Public names of packages: found in the source, imported at their first use."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

from manyeyes._lazy import Definition, find_public_names

INIT = """
from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from shapes.circle import PI as PI, area as circle_area

__getattr__, __dir__ = attach(__name__)
"""


@pytest.fixture
def shapes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "shapes"
    folder.mkdir()
    (folder / "__init__.py").write_text(INIT)
    (folder / "circle.py").write_text("PI = 3\ndef area(radius): return PI * radius ** 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield __import__("shapes")
    for name in ("shapes", "shapes.circle"):
        sys.modules.pop(name, None)


def test_names_are_those_imported_for_type_checkers() -> None:
    assert find_public_names(ast.parse(INIT)) == {
        "PI": Definition("shapes.circle", "PI"),
        "circle_area": Definition("shapes.circle", "area"),
    }
    assert find_public_names(ast.parse("from math import pi\n")) == {}


def test_a_name_is_imported_at_its_first_use(shapes) -> None:
    assert "PI" in dir(shapes) and "circle_area" in dir(shapes)
    assert shapes.__all__ == ["PI", "circle_area"]
    assert "shapes.circle" not in sys.modules
    assert shapes.circle_area(2) == 12
    assert vars(shapes)["circle_area"] is sys.modules["shapes.circle"].area


def test_a_name_that_is_not_public_is_an_attribute_error(shapes) -> None:
    with pytest.raises(AttributeError, match="module 'shapes' has no attribute 'square'"):
        shapes.square  # noqa: B018
    assert not hasattr(shapes, "__wrapped__")
    with pytest.raises(ImportError):
        from shapes import square  # noqa: F401
