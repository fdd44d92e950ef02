# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses and named tuples of arrays as scratch files: their fields are arrays, tuples of texts or such values again.

Which arrays are read-only is kept, as compiled loops have one version for those and one for others.
"""

from __future__ import annotations

import zipfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from manyeyes._io import atomic_replace

T = TypeVar("T")

_READ_ONLY = "!"


def save_columns(path: Path, value: object) -> None:
    """Write a value to an uncompressed ``.npz``: whole, or not there."""
    arrays: dict[str, np.ndarray] = {}
    _flatten(value, "", arrays)
    with atomic_replace(path, durable=False) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType] - arrays have names that are no parameters


def load_columns(path: Path, kind: type[T]) -> T | None:
    """The value of a file that :func:`save_columns` wrote; None where there is no such file, or a damaged one."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return _unflatten(kind, "", {name: stored[name] for name in stored.files})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _flatten(value: object, prefix: str, arrays: dict[str, np.ndarray]) -> None:
    for field in _field_names(type(value)):
        item = getattr(value, field)
        if _field_names(type(item)):
            _flatten(item, f"{prefix}{field}.", arrays)
        else:
            array = np.array(item, dtype=np.str_) if isinstance(item, tuple) else np.asarray(item)
            arrays[prefix + field + ("" if array.flags.writeable else _READ_ONLY)] = array


def _unflatten(kind: type[T], prefix: str, arrays: dict[str, np.ndarray]) -> T:
    hints = get_type_hints(kind)
    made: dict[str, Any] = {}
    for field in _field_names(kind):
        hint = hints[field]
        if isinstance(hint, type) and _field_names(hint):
            made[field] = _unflatten(hint, f"{prefix}{field}.", arrays)
            continue
        name = prefix + field
        array = arrays[name if name in arrays else name + _READ_ONLY]
        array.flags.writeable = name in arrays
        made[field] = tuple(array.tolist()) if array.dtype.kind == "U" else array
    return kind(**made)


def _field_names(kind: type) -> tuple[str, ...]:
    """Names of the fields of a dataclass or a named tuple; none of any other type."""
    if is_dataclass(kind):
        return tuple(f.name for f in fields(kind))
    return getattr(kind, "_fields", ())
