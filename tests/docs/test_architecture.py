# SPDX-License-Identifier: Apache-2.0
"""The page on the architecture lists the layers of the import contract and the extension points of the code."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "concepts" / "architecture.md").read_text(encoding="utf-8")


def test_layers_are_those_of_the_import_contract() -> None:
    (contract,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    listed = re.findall(r"^\| -?\d+ \| (.*?) \|", TEXT, re.MULTILINE)
    assert [set(re.findall(r"`(\w+)`", row)) for row in listed] == [
        {name.strip() for name in layer.split("|")} for layer in contract["layers"]
    ]


def test_extension_points_are_the_groups_of_entry_points_of_the_code() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "src" / "manyeyes").rglob("*.py"))
    groups = set(
        re.findall(
            r'"(manyeyes\.(?:fusion|strategy|detector|dataset|pose_corrector|map_fusion|misbehaviour))"', sources
        )
    )
    assert groups and set(re.findall(r"`(manyeyes\.\w+)`", TEXT.partition("## Extension points")[2])) == groups
    for name in re.findall(r"`(register_\w+)\(", TEXT):
        assert re.search(rf"^(?:def )?{name}\b", sources, re.MULTILINE), name
