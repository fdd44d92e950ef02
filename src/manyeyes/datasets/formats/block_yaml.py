# SPDX-License-Identifier: Apache-2.0
"""Plain block yaml, read by lines: what recordings in OPV2V's layout consist of, several times as fast as by libyaml.

Accepted are block mappings and block sequences of numbers, booleans, words, and lists of numbers in brackets, one entry a line, as
PyYAML writes them. For anything else (comments, quotes, tags, anchors, aliases, merge keys, nulls, other types of a scalar, deep
nesting, irregular indentation) the result is None, and the complete loader decides.
"""

from __future__ import annotations

import re
from typing import Any

_MAX_DEPTH = 12
_FLOAT = r"-?[0-9]{1,400}\.[0-9]{0,400}(?:[eE][+-][0-9]{1,6})?"
_WHOLE = r"-?(?:0|[1-9][0-9]{0,17})"
_NUMBERS = rf"\[(?:(?:{_FLOAT}|{_WHOLE})(?:, (?:{_FLOAT}|{_WHOLE}))*)?\]"
_WORD = r"[A-Za-z][A-Za-z0-9_.-]*|[0-9]{1,3}, [0-9]{1,3}, [0-9]{1,3}"
_KEY = rf"[A-Za-z][A-Za-z0-9_]{{0,63}}|{_WHOLE}"
# Groups: indentation; dashes or a key; and at most one of a float, a whole number, a word or a colour, numbers in brackets or {}.
_LINE = re.compile(
    rf"^( *)(?:((?:- )+)|({_KEY}):(?: (?=.)|$))(?:({_FLOAT})|({_WHOLE})|({_WORD})|({_NUMBERS}|\{{\}}))?$", re.MULTILINE
)
_BOOLEANS = {"true": True, "false": False}
# Words that yaml 1.1 takes for no string, in any case; those that are no key of _BOOLEANS are left to the complete loader.
_RESERVED = frozenset(("yes", "no", "on", "off", "true", "false", "null"))


class _UnexpectedError(Exception):
    """Something that is left to the complete loader."""


def _read_word(text: str) -> str | bool:
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if text.lower() in _RESERVED:
        raise _UnexpectedError
    return text


def _read_key(text: str) -> str | int:
    if text[0].isalpha():
        if text.lower() in _RESERVED:
            raise _UnexpectedError
        return text
    return int(text)


def _read_brackets(text: str) -> list[float | int] | dict[Any, Any]:
    if text == "{}":
        return {}
    items = text[1:-1].split(", ") if len(text) > 2 else []
    return [float(item) if "." in item else int(item) for item in items]


class _Builder:
    """Containers under construction, the innermost last; ``open_key`` is a key whose value begins on the next line."""

    def __init__(self) -> None:
        self.top: dict[Any, Any] = {}
        self._columns, self._containers = [0], list[Any]([self.top])
        self._open_key: Any = None

    def add_entry(self, column: int, key: Any, value: Any) -> None:
        """Add ``key: value``; None opens the key."""
        mapping = self._find_mapping(column)
        if value is None:
            self._open_key = key
        else:
            mapping[key] = value

    def add_item(self, column: int, num_dashes: int, value: Any) -> None:
        """Add ``- value``, or with more dashes the first item of nested sequences."""
        if value is None:
            raise _UnexpectedError
        self._find_sequence(column)
        for depth in range(1, num_dashes):
            inner: list[Any] = []
            self._containers[-1].append(inner)
            self._push(column + 2 * depth, inner)
        self._containers[-1].append(value)

    def close(self) -> dict[Any, Any]:
        """Return the mapping at the top."""
        if self._open_key is not None:
            raise _UnexpectedError
        return self.top

    def _find_mapping(self, column: int) -> dict[Any, Any]:
        columns, containers = self._columns, self._containers
        if self._open_key is not None:
            mapping: dict[Any, Any] = {}
            self._open(column, mapping, columns[-1] + 1)
            return mapping
        while columns[-1] > column or (columns[-1] == column and type(containers[-1]) is list):
            columns.pop()
            containers.pop()
        if columns[-1] != column:
            raise _UnexpectedError
        return containers[-1]

    def _find_sequence(self, column: int) -> None:
        if self._open_key is not None:
            self._open(column, [], self._columns[-1])
            return
        columns, containers = self._columns, self._containers
        while columns[-1] > column:
            columns.pop()
            containers.pop()
        if columns[-1] != column or type(containers[-1]) is not list:
            raise _UnexpectedError

    def _open(self, column: int, container: Any, min_column: int) -> None:
        if column < min_column:
            raise _UnexpectedError
        self._containers[-1][self._open_key] = container
        self._open_key = None
        self._push(column, container)

    def _push(self, column: int, container: Any) -> None:
        if len(self._columns) >= _MAX_DEPTH:
            raise _UnexpectedError
        self._columns.append(column)
        self._containers.append(container)


def parse_block_yaml(content: bytes) -> dict[Any, Any] | None:
    """Return the mapping that plain block yaml stands for; None where it is anything else, valid or not."""
    if not content.isascii():
        return None
    text = content.decode("ascii").removesuffix("\n")
    lines = _LINE.findall(text)
    if len(lines) != text.count("\n") + 1:
        return None
    builder = _Builder()
    try:
        for spaces, dashes, key, number, whole, word, brackets in lines:
            if number:
                value = float(number)
            elif whole:
                value = int(whole)
            elif word:
                value = _read_word(word)
            else:
                value = _read_brackets(brackets) if brackets else None
            if dashes:
                builder.add_item(len(spaces), len(dashes) // 2, value)
            else:
                builder.add_entry(len(spaces), _read_key(key), value)
        return builder.close()
    except _UnexpectedError:
        return None
