# SPDX-License-Identifier: Apache-2.0
"""The command line that stands for options, so that a result names the command that makes it again."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator
from typing import Any

INDEPENDENT_OPTIONS = frozenset({"out", "workers"})
"""Options that no result depends on."""


def format_command(command: str, options: Any) -> str:
    """Return ``manyeyes COMMAND`` with the options that differ from their defaults; those of INDEPENDENT_OPTIONS are left out.

    options: a dataclass of options; a field that is a dataclass has options of its own.
    """
    return shlex.join(["manyeyes", *command.split(), *_list_words(options, None)])


def _list_words(options: Any, defaults: Any) -> Iterator[str]:
    """Yield the words of a dataclass. defaults: an instance with them; None: those of its fields."""
    for field in dataclasses.fields(options):
        value, default = getattr(options, field.name), _default_of(field, defaults)
        flag = field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _list_words(value, default)
        elif value == default or value is None or field.name in INDEPENDENT_OPTIONS:
            continue
        elif isinstance(value, bool):
            yield f"--{flag}" if value else f"--no-{flag}"
        elif isinstance(value, tuple):
            yield f"--{flag}"
            yield from map(str, value)
        else:
            yield f"--{flag}"
            yield str(value)


def _default_of(field: dataclasses.Field[Any], defaults: Any) -> Any:
    if defaults is not None:
        return getattr(defaults, field.name)
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
