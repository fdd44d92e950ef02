# SPDX-License-Identifier: Apache-2.0
"""Check of parsed options against the bounds of their types (``manyeyes._bounds``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

from manyeyes._bounds import Bounds


def find_violation(options: Any) -> str | None:
    """Describe the first option of a dataclass whose number is outside its bounds; None where all fit."""
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        value: Any = getattr(options, name)
        if is_dataclass(value):
            if violation := find_violation(value):
                return violation
            continue
        for bounds in _bounds_of(hint):
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not bounds.contains(number):
                    return f"--{name.replace('_', '-')} needs {bounds.text}; got {number}."
    return None


def _bounds_of(hint: Any) -> Iterator[Bounds]:
    """Iterate over the bounds in a type, also within optional types and tuples."""
    yield from (item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Bounds))
    for part in get_args(hint):
        yield from _bounds_of(part)
