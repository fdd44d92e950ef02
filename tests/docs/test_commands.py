# SPDX-License-Identifier: Apache-2.0
"""Commands and options in the documents are those of the command line."""

import contextlib
import functools
import io
import re
from pathlib import Path

import pytest

from manyeyes.cli.main import COMMAND_GROUPS, COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "src").rglob("*.md")])


def find_commands(text: str) -> list[list[str]]:
    """The words of each ``manyeyes ...`` in code blocks and code spans."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.S)
    lines = [line.partition(" #")[0] for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    spans = re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.S))
    return [code.split()[1:] for code in (*lines, *spans) if re.match(r"manyeyes [a-z]", code)]


@functools.cache
def read_help(*command: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main([*command, "--help"])
    return out.getvalue()


def find_unknown(words: list[str]) -> list[str]:
    """The first unknown word of a command, or its options that its help does not list."""
    if words[0] not in COMMANDS:
        return words[:1]
    options = {name for word in words for name in re.findall(r"^\[?(--[a-z][a-z0-9-]*)", word)}
    if words[:2] == ["study", "NAME"]:
        helps = [read_help("study", name) for name in COMMAND_GROUPS["study"]]
        return sorted(name for name in options if not any(re.search(rf"{name}\b(?!-)", text) for text in helps))
    command = words[:1]
    if words[0] in COMMAND_GROUPS and len(words) > 1 and re.fullmatch(r"[a-z][a-z0-9-]+", words[1]):
        if words[1] not in COMMAND_GROUPS[words[0]]:
            return words[:2]
        command = words[:2]
    return sorted(name for name in options if not re.search(rf"{name}\b(?!-)", read_help(*command)))


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(path.relative_to(ROOT)) for path in DOCUMENTS])
def test_commands_of_a_document_exist(path):
    text = re.sub(r"^### Renamed.*?(?=^###)", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    assert {" ".join(words): unknown for words in find_commands(text) if (unknown := find_unknown(words))} == {}


def test_unknown_commands_and_options_are_found():
    text = "`manyeyes map fuse F --none` `manyeyes map none` `manyeyes none`\n```\nmanyeyes view R --out \\\n  --none\n```\n"
    assert [find_unknown(words) for words in find_commands(text)] == [["--none"], ["--none"], ["map", "none"], ["none"]]
