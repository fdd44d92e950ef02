# SPDX-License-Identifier: Apache-2.0
"""Exceptions of manyeyes; each text gives the expected value, the actual value, and a remedy."""

from __future__ import annotations

import reprlib

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60


def shorten(value: object) -> str:
    """Write a value of a file for the text of an error: at most 80 characters, also where aliases nest it."""
    text = " ".join(_REPR.repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


class ManyeyesError(Exception):
    """Base of all designed errors: the command line prints its one line and exits with 1."""


class ShapeError(ManyeyesError, ValueError):
    """A tensor whose shape or dtype does not fit the type it is given to."""


class ConfigError(ManyeyesError, ValueError):
    """A setting or preset that does not exist or does not fit; the text lists the known ones."""


class RecordingError(ManyeyesError):
    """A file of a recording that is missing, truncated or contradictory; the text names file and field."""


class WireError(ManyeyesError):
    """Bytes that are not a whole, matching message; the receiver drops them and counts them."""


class CheckpointError(ManyeyesError):
    """Weights that are missing, damaged or of another shape."""


class MissingExtraError(ManyeyesError, ImportError):
    """An optional dependency is not installed; the text is the pip line that installs it.

    extra: its name, or several joined by commas. purpose: what needs it, the subject of the sentence.
    """

    def __init__(self, extra: str, purpose: str) -> None:
        names = " and ".join(f"'{name}'" for name in extra.split(","))
        noun = "extras" if "," in extra else "extra"
        others = f"with a wheel in FOLDER: --find-links FOLDER; in a checkout: pip install -e '.[{extra}]'"
        line = f"pip install 'manyeyes[{extra}]' ({others})"
        super().__init__(f"{purpose} needs the {names} {noun}: {line}")
        self._arguments = extra, purpose

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        # A worker process sends its errors pickled; by default they are made again from the text alone.
        return type(self), self._arguments
