# SPDX-License-Identifier: Apache-2.0
"""JSON files of recordings: values by their keys; errors name file, key and remedy. Numbers may be written as strings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manyeyes._io import parse_json, read_file
from manyeyes.datatypes import RecordingError
from manyeyes.datatypes.errors import shorten

REMEDY = "copy or download the file again"
_MAX_DEPTH = 8


def load_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        return parse_json(read_file(path))
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, expected JSON; {REMEDY}.") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}), expected JSON; {REMEDY}.") from None
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path}: expected JSON, found something else ({reason}); {REMEDY}.") from None


def load_list(path: Path) -> list[Mapping[str, Any]]:
    """Return the objects of a JSON file that holds a list of them."""
    content = load_json(path)
    if not isinstance(content, list) or not all(isinstance(entry, Mapping) for entry in content):
        found = type(content).__name__ if not isinstance(content, list) else "other things in it"
        raise RecordingError(f"{path}: expected a list of JSON objects, found {found}; {REMEDY}.")
    return content


def get_field(path: Path, content: Any, key: str, json_path: str = "") -> Any:
    """Return the value of a key that has to be there."""
    if not isinstance(content, Mapping) or key not in content:
        raise RecordingError(f"{path}: expected the key '{join_path(json_path, key)}', found none; {REMEDY}.")
    return content[key]


def get_text(path: Path, content: Any, key: str, json_path: str = "") -> str:
    """Return a value that has to be a text with something in it."""
    found = get_field(path, content, key, json_path)
    if not isinstance(found, str) or not found:
        raise RecordingError(
            f"{path}: expected a text at '{join_path(json_path, key)}', found {shorten(found)}; {REMEDY}."
        )
    return found


def get_number(path: Path, content: Any, key: str, json_path: str = "", blank: float | None = None) -> float:
    """Return a finite number, written as such or as a string; blank: what an empty string stands for, None: an error."""
    found = get_field(path, content, key, json_path)
    if found == "" and blank is not None:
        return blank
    value = _number(found)
    if value is None:
        raise RecordingError(
            f"{path}: expected a number at '{join_path(json_path, key)}', found {shorten(found)}; {REMEDY}."
        )
    return value


def join_path(json_path: str, key: str) -> str:
    """Return the path of a key below another, for error texts."""
    return f"{json_path}.{key}" if json_path else key


def _number(found: object) -> float | None:
    if isinstance(found, bool) or not isinstance(found, (int, float, str)):
        return None
    try:
        value = float(found)
    except (ValueError, OverflowError):
        return None
    return value if np.isfinite(value) else None


def get_array(path: Path, found: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return an array of the shape, from nested lists of numbers or strings in any nesting of as many."""
    values = _flat(found)
    if values is None or len(values) != int(np.prod(shape)):
        what = " x ".join(map(str, shape))
        raise RecordingError(f"{path}: expected {what} finite numbers at '{name}', found {shorten(found)}; {REMEDY}.")
    return np.asarray(values, np.float64).reshape(shape)


def _flat(found: object, depth: int = 0) -> list[float] | None:
    if isinstance(found, Sequence) and not isinstance(found, str) and depth < _MAX_DEPTH:
        parts = [_flat(entry, depth + 1) for entry in found]
        return None if any(part is None for part in parts) else [v for part in parts for v in part or ()]
    value = _number(found)
    return None if value is None else [value]
