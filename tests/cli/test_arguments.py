# SPDX-License-Identifier: Apache-2.0
"""Wrong arguments are one line on the error stream and exit code 2; flags are pairs."""

from __future__ import annotations

import io
import sys

import pytest
import tyro

from manyeyes.cli import main as cli
from manyeyes.cli.arguments import PARSER_CONFIG, parse_options

COMMANDS = sorted({name for name in cli.COMMANDS if name not in cli.COMMAND_GROUPS}) + [
    f"{group} {name}" for group, names in cli.COMMAND_GROUPS.items() for name in names
]

WRONG_ARGUMENTS = {
    "doctor --colour": "Unrecognized options: --colour.",
    "view data --detec late": "Unrecognized options: --detec, late; did you mean --detect?",
    "demo --animate yes": "Unrecognized options: yes.",
    "demo --no-animat": "did you mean --animate, --no-animate?",
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


@pytest.mark.filterwarnings("ignore:get_parser:DeprecationWarning")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_flag_is_a_pair_whose_default_reads_as_its_help_does(command: str) -> None:
    """'--no-animate  Draw the animation. (default: True)' reads inverted; '--animate, --no-animate' does not."""
    parser = tyro.extras.get_parser(cli.load_command(command).options, config=PARSER_CONFIG)
    flags = [action for action in parser._actions if type(action.default) is bool and action.nargs == 0]
    for flag in flags:
        on, off = (name for name in flag.option_strings if name.startswith("--"))
        assert off == f"--no-{on.removeprefix('--')}" and not on.startswith("--no-")


def test_both_forms_of_a_flag_are_taken() -> None:
    from manyeyes.cli.demo import Options

    for words, animate in {"": True, "--animate": True, "--no-animate": False}.items():
        assert parse_options(Options, "manyeyes demo", None, words.split()).animate is animate


def test_the_help_of_a_flag_reads_upright(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        cli.main(["demo", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--animate, --no-animate Draw the animation of the drive. (default: True)" in text
