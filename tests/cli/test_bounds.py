# SPDX-License-Identifier: Apache-2.0
"""Numbers of options are refused where they are parsed: one line that names the option, exit code 2."""

import dataclasses
import typing
from typing import Any

import pytest

from manyeyes._bounds import Bounds, Fraction, NonNegativeFloat, PositiveFloat, PositiveInt
from manyeyes.cli import main as cli
from manyeyes.cli.bounds import find_violation

COMMANDS = [command for command in cli.COMMANDS if command not in cli.COMMAND_GROUPS]
COMMANDS += [f"{group} {command}" for group, commands in cli.COMMAND_GROUPS.items() for command in commands]
BAD = {
    "-1": -1.0,
    "0": 0.0,
    "2.5": 2.5,
    "nan": float("nan"),
    "inf": float("inf"),
    "1e400": float("inf"),
    "x": None,
    str(2**70): 2.0**70,
}


def numeric_options(options: type) -> dict[str, tuple[Any, type]]:
    """Bounds (None without) and number type of every numeric option, also of nested dataclasses."""
    found: dict[str, tuple[Any, type]] = {}
    for name, hint in typing.get_type_hints(options, include_extras=True).items():
        if dataclasses.is_dataclass(hint):
            found |= numeric_options(typing.cast(type, hint))
        parts = [hint]
        for part in parts:
            parts += typing.get_args(part)
            if part in (int, float):
                found.setdefault(name, (None, part))
            for item in getattr(part, "__metadata__", ()):
                if isinstance(item, Bounds) and found.get(name, (None,))[0] is None:
                    found[name] = item, part.__origin__
    return found


def required_arguments(options: type, without: str) -> list[str]:
    """Arguments of the fields without a default."""
    words = []
    hints = typing.get_type_hints(options, include_extras=True)
    for field in dataclasses.fields(options):
        if dataclasses.MISSING is field.default is field.default_factory and field.name != without:
            flag = [] if getattr(hints[field.name], "__metadata__", ()) else [f"--{field.name.replace('_', '-')}"]
            words += [*flag, "somewhere"]
    return words


@pytest.mark.parametrize("command", COMMANDS)
def test_numbers_outside_their_bounds_are_refused(command: str, monkeypatch, capsys) -> None:
    options_class = cli.load_command(command).options
    accepted = cli.Command(options_class, lambda options: pytest.fail(f"accepted {options}"), "")
    monkeypatch.setattr(cli, "load_command", lambda command: accepted)
    for name, (bounds, kind) in numeric_options(options_class).items():
        assert bounds is not None, f"--{name} of {command} has no bounds"
        flag = f"--{name.replace('_', '-')}"
        for text, value in BAD.items():
            if value is not None and bounds.contains(value) and (kind is float or value.is_integer()):
                continue
            for repeats in ([text], [text, text]):
                code = cli.main([*command.split(), *required_arguments(options_class, name), flag, *repeats])
                assert code == 2, (flag, text)
                message = capsys.readouterr().err
                if "needs" in message:
                    break
            if value is not None and kind is float:
                assert message.startswith(f"manyeyes: {flag} needs {bounds.text}; got {value}"), message
            assert message.count("\n") == 1


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: NonNegativeFloat = 0.0


@dataclasses.dataclass(frozen=True)
class Outer:
    steps: PositiveInt | None = None
    parts: tuple[Fraction, ...] = ()
    width_m: PositiveFloat = 1.0
    inner: Inner = dataclasses.field(default_factory=Inner)


@pytest.mark.parametrize(
    ("options", "violation"),
    [
        (Outer(), None),
        (Outer(1, (0.0, 1.0), 1e-300, Inner(1e300)), None),
        (Outer(steps=0), "--steps needs an integer from 1 to 2**63 - 1; got 0."),
        (Outer(steps=2**63), "--steps needs an integer from 1 to 2**63 - 1; got 9223372036854775808."),
        (Outer(parts=(0.5, 1.1)), "--parts needs a number from 0 to 1; got 1.1."),
        (Outer(width_m=0.0), "--width-m needs a finite number above 0; got 0.0."),
        (Outer(inner=Inner(float("inf"))), "--rate needs a finite number of at least 0; got inf."),
    ],
)
def test_the_first_violation_is_described(options: Outer, violation: str | None) -> None:
    assert find_violation(options) == violation
