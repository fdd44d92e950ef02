# SPDX-License-Identifier: Apache-2.0
"""The table of the diagnosis: one line each, with what is missing and what to do."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from rich.console import Console

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
