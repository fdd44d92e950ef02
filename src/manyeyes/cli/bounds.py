# SPDX-License-Identifier: Apache-2.0
"""Check of parsed options, before any work, against the bounds and roles of their types (``manyeyes._bounds``)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from manyeyes._bounds import Bounds, PathRole


def find_violation(options: Any) -> str | None:
    """Describe the first option of a dataclass whose number is outside its bounds or whose path is unusable; None where all fit."""
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        value: Any = getattr(options, name)
        if is_dataclass(value):
            if violation := find_violation(value):
                return violation
            continue
        for requirement, part in _requirements(hint, value):
            if problem := _describe_problem(requirement, part):
                return f"--{name.replace('_', '-')} needs {problem}."
    return None


def _requirements(hint: Any, value: Any) -> Iterator[tuple[Bounds | PathRole, Any]]:
    """Iterate over the parts of a value with the requirements of their types, also within optional types and tuples."""
    if value is None:
        return
    yield from ((item, value) for item in getattr(hint, "__metadata__", ()) if isinstance(item, Bounds | PathRole))
    parts = get_args(hint)
    if get_origin(hint) is tuple:
        parts = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        for part, item in zip(parts, value):
            yield from _requirements(part, item)
    else:
        for part in parts:
            yield from _requirements(part, value)


def _describe_problem(requirement: Bounds | PathRole, value: Any) -> str | None:
    if isinstance(requirement, Bounds):
        return None if requirement.contains(value) else f"{requirement.text}; got {value}"
    if requirement.kind == "input":
        return None if value.exists() else f"an existing file or folder; there is no {value}"
    if requirement.kind == "input map":
        from manyeyes.maps.store.map_place import MapPlace

        return None if MapPlace.parse(value).exists() else f"a map's folder, or the URL of a store; there is no {value}"
    return _describe_output_problem(value, requirement.kind == "output folder")


def _describe_output_problem(path: Path, is_folder: bool) -> str | None:
    """Describe why a file or folder cannot be written, by what is there now; None where it can."""
    if path.exists() and path.is_dir() != is_folder:
        return f"a folder to write to; {path} is a file" if is_folder else f"a file to write; {path} is a folder"
    there = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not there.is_dir() and there != path:
        return f"a path in a folder; {there} is a file"
    return None if os.access(there, os.W_OK) else f"a place to write to; {there} is write-protected"
