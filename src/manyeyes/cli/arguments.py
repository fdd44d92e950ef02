# SPDX-License-Identifier: Apache-2.0
"""Parse the arguments of one command to its Options; wrong arguments are an error of one line."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any

import tyro

from manyeyes.cli.bounds import find_violation

PARSER_CONFIG = (tyro.conf.OmitArgPrefixes,)
"""Settings of every parser. A flag is a pair, --animate and --no-animate: help and default are those of the flag that is on."""
_COLOUR = re.compile("\x1b\\[[0-9;]*m")
_FRAME = re.compile("[│╭╮╰╯]|[─-]{3,}")
"""What tyro draws around an error: sides of a box, and rules, of hyphens where the encoding is not UTF-8."""


class UsageError(Exception):
    """Wrong arguments; the text is one line."""


def parse_options(options_type: Any, prog: str, description: str | None, arguments: Sequence[str]) -> Any:
    """Parse arguments to an instance of a dataclass of options.

    Options of a nested dataclass keep their short names: --channel, not --replay-options.channel.

    Raises:
        UsageError: an option is unknown, missing or wrong; the text names it and, of an unknown one, those with near names.
        SystemExit: after --help.
    """
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            options = tyro.cli(
                options_type, args=list(arguments), prog=prog, description=description, config=PARSER_CONFIG
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(f"{_summarize_error(errors.getvalue())} {prog} --help lists the options.") from None
    if violation := find_violation(options):
        raise UsageError(violation)
    return options


def _summarize_error(box: str) -> str:
    """Reduce tyro's box (a title, a message, and between rules suggestions and hints) to the message and suggested names."""
    lines = (_FRAME.sub("", line).strip() for line in _COLOUR.sub("", box).splitlines())
    message, *hints = "\n".join(lines).partition("\n")[2].strip().split("\n\n")
    names = [
        name
        for hint in hints
        if hint.startswith("Perhaps")
        for name in re.findall(r"^--[\w-]+(?:, --no-[\w-]+)?", hint, re.MULTILINE)
    ]
    message = message.replace("\n", " ").rstrip(".")
    return f"{message}; did you mean {' or '.join(names)}?" if names else f"{message}."
