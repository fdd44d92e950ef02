# SPDX-License-Identifier: Apache-2.0
"""The table of the diagnosis: one line each, with what is missing and what to do."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from manyeyes.cli import compile_ahead, main as cli
from manyeyes.cli.compile_ahead import CompiledAhead
from manyeyes.cli.doctor import Diagnosis, _table

DIAGNOSIS = Diagnosis(
    {"manyeyes": "0.1.0", "shapely": None}, None, "Linux", "a processor", 4, 2, "none", (), (), (), "none; install py123d", "/p"
)  # fmt: skip


def read_lines(diagnosis: Diagnosis) -> dict[str, str]:
    """The printed table: value by name."""
    out = io.StringIO()
    Console(file=out, width=120).print(_table(diagnosis))
    cells = [[part.strip() for part in line.strip("│┃ \n").split("  ", 1)] for line in out.getvalue().splitlines()]
    return {cell[0]: cell[-1] for cell in cells if len(cell) == 2}


@pytest.mark.parametrize(
    ("changes", "name", "wanted"),
    [
        ({}, "versions", "manyeyes 0.1.0"),
        ({}, "commit", "not a checkout"),
        ({"git_commit": "abc"}, "commit", "abc"),
        ({}, "processor", "a processor, 4 cores; torch uses 2 threads"),
        ({}, "towns", "none; install py123d"),
        ({"towns": ("Town01", "Town05"), "towns_from": "/maps"}, "towns", "Town01, Town05 from /maps"),
    ],
)
def test_a_line_of_the_table(changes: dict[str, object], name: str, wanted: str) -> None:
    assert read_lines(replace(DIAGNOSIS, **changes))[name] == wanted


@pytest.mark.parametrize(
    ("compiled", "wanted"),
    [
        (CompiledAhead(118, Path("/cache")), "118 loops compiled in 0 s; they are kept in /cache"),
        (None, "Nothing was compiled: loops cannot be kept"),
    ],
)
def test_loops_are_compiled_instead_of_the_diagnosis(
    compiled: CompiledAhead | None, wanted: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def compile_nothing(progress: Callable[[int], None]) -> CompiledAhead | None:
        progress(3)
        return compiled

    monkeypatch.setattr(compile_ahead, "compile_ahead", compile_nothing)
    assert cli.main(["doctor", "--compile"]) == 0
    out = capsys.readouterr().out
    assert wanted in out and "versions" not in out


def test_compiling_has_no_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--compile", "--json"]) == 1
    assert "--json is the form of the diagnosis" in capsys.readouterr().err
