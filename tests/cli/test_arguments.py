# SPDX-License-Identifier: Apache-2.0
"""Wrong arguments are one line on the error stream and exit code 2."""

from __future__ import annotations

import io
import sys

import pytest

from manyeyes.cli import main as cli

WRONG_ARGUMENTS = {
    "doctor --colour": "Unrecognized options: --colour.",
    "view data --detec late": "Unrecognized options: --detec, late; did you mean --detect?",
    "demo --animate yes": "did you mean --no-animate?",
    "demo --seed x": "Error parsing --seed: invalid literal for int() with base 10: 'x'.",
    "demo --seed -1": "--seed needs an integer from 0 to 2**63 - 1; got -1.",
    "demo --out": "Missing value for argument '--out'.",
    "demo --token-encoding float8": "invalid choice 'float8' for argument '--token-encoding'.",
    "map retract store": "--reason STR",
    "map fuse": "PATH A Parquet file of observations",
}


@pytest.mark.parametrize("arguments", WRONG_ARGUMENTS)
@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
@pytest.mark.parametrize("columns", ["40", "200"])
def test_wrong_arguments_are_one_line_and_exit_with_2(
    arguments: str, columns: str, encoding: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding))
    assert cli.main(arguments.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("manyeyes: ") and err.count("\n") == 1
    assert WRONG_ARGUMENTS[arguments] in err
    assert not set(err) & set("│╭╮╰╯─+|\x1b") and "---" not in err
