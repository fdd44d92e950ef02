# SPDX-License-Identifier: Apache-2.0
"""Every place in the code that docs/method.md names is there."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`([\w/]+\.py)(?:::([\w.]+))?`", TEXT)))


def names_in(path: Path) -> set[str]:
    """Functions, classes, their methods and fields, and constants."""
    found: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            found.update(prefix + t.id for t in targets if isinstance(t, ast.Name))

    visit(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return found


def test_the_page_names_places():
    assert len(NAMED) > 30
    assert {"3", "4", "5", "13"} <= set(re.findall(r"^\| (\d+)", TEXT, re.MULTILINE))


@pytest.mark.parametrize(("file", "symbol"), NAMED, ids=["::".join(filter(None, n)) for n in NAMED])
def test_a_named_place_exists(file, symbol):
    path = ROOT / "src" / "manyeyes" / file
    assert path.is_file(), f"docs/method.md names {file}, which is not in src/manyeyes"
    assert not symbol or symbol in names_in(path), f"docs/method.md names {symbol} in {file}, which has no such thing"


def test_settings_that_the_page_quotes():
    source = (ROOT / "src" / "manyeyes" / "models" / "detector" / "encoder.py").read_text(encoding="utf-8")
    for field in re.findall(r"`EncoderConfig\.(\w+)", TEXT):
        assert re.search(rf"^    {field}:", source, re.MULTILINE), field
