# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses and named tuples as files: numbers and texts as JSON, arrays and tensors as bytes behind it.

Which arrays are read-only is kept, as compiled loops have one version for those and one for others. A checksum covers every part.
Arrays begin at multiples of 16 bytes, so that read-only ones of bytes in memory are views of them.
"""

from __future__ import annotations

import io
import json
import math
import types
import zlib
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from manyeyes._io import atomic_write

T = TypeVar("T")

_PLAIN = (str, int, float, bool)
_ALIGNMENT = 16


def save_record(path: Path, value: object, durable: bool = False) -> None:
    """Write a value to a file: whole, or not there; durable: also after a loss of power.

    Fields are numbers, texts, enumerations, None, arrays, tensors, tuples of these, and such dataclasses or named tuples again.
    """
    atomic_write(path, *_chunks_of(value), durable=durable)


def pack_record(value: object) -> bytes:
    """Return the bytes of the file that :func:`save_record` writes."""
    return b"".join(_chunks_of(value))


def _chunks_of(value: object) -> list[bytes | memoryview]:
    arrays: list[np.ndarray] = []
    header = json.dumps(_pack(value, arrays)).encode()
    chunks: list[bytes | memoryview] = [b"%08x" % zlib.crc32(header), header, b"\n"]
    length = len(header) + 9
    for array in arrays:
        if array.size:
            chunks += [bytes(-length % _ALIGNMENT), _bytes_of(array)]
            length += -length % _ALIGNMENT + array.nbytes
    return chunks


def load_record(path: Path, kind: type[T]) -> T | None:
    """Read the value of a file of :func:`save_record`; None where there is no such file, a damaged one, or one of another type."""
    try:
        with path.open("rb") as file:
            return _read_record(file, kind)
    except OSError:
        return None


def unpack_record(data: bytes, kind: type[T]) -> T | None:
    """Return the value of bytes of :func:`pack_record`; None for damaged ones, or ones of another type.

    Read-only arrays are views of the bytes.
    """
    return _read_record(_Memory(data), kind)


class _Memory(io.BytesIO):
    """Bytes as a file that hands out views of them."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._data = data

    def view(self, shape: Any, dtype: np.dtype[Any]) -> np.ndarray:
        """Return a read-only array of the bytes that are next; ValueError where they are not enough."""
        array = np.frombuffer(self._data, dtype, math.prod(shape), self.tell()).reshape(shape)
        self.seek(array.nbytes, io.SEEK_CUR)
        return array


def _read_record(file: io.BufferedIOBase, kind: type[T]) -> T | None:
    try:
        checksum, header = file.read(8), file.readline()[:-1]
        if int(checksum, 16) != zlib.crc32(header):
            return None
        return _unpack(kind, json.loads(header), file)
    except (OSError, ValueError, TypeError, EOFError, AttributeError):
        return None


def _pack(value: Any, arrays: list[np.ndarray]) -> Any:
    """A value as JSON can hold it; arrays are appended, each stands as type, shape, order, whether writeable, and checksum."""
    if names := _field_names(type(value)):
        return [_pack(getattr(value, name), arrays) for name in names]
    if isinstance(value, (tuple, list)):
        return [_pack(item, arrays) for item in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (np.generic, int, float, str)) or value is None:
        return value.item() if isinstance(value, np.generic) else value
    array = value.numpy() if hasattr(value, "numpy") else np.asarray(value)
    arrays.append(array)
    is_transposed = array.flags.fnc
    shape = array.shape[::-1] if is_transposed else array.shape
    return [array.dtype.str, shape, is_transposed, array.flags.writeable, zlib.crc32(_bytes_of(array))]


def _bytes_of(array: np.ndarray) -> memoryview:
    """The bytes (N,) of an array as it lies in memory."""
    return np.ascontiguousarray(array.T if array.flags.fnc else array).reshape(-1).view(np.uint8).data


def _unpack(hint: Any, packed: Any, file: io.BufferedIOBase) -> Any:
    if names := _field_names(hint):
        if len(packed) != len(names):
            raise ValueError("another layout")
        hints = _hints_of(hint)
        return hint(**{name: _unpack(hints[name], item, file) for name, item in zip(names, packed)})
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is tuple:
        if arguments[0] in _PLAIN and arguments[1:] == (Ellipsis,):
            return tuple(packed)
        item_hints = arguments[:1] * len(packed) if arguments[-1] is Ellipsis else arguments
        return tuple(_unpack(item_hint, item, file) for item_hint, item in zip(item_hints, packed, strict=True))
    if origin in (Union, types.UnionType):
        return None if packed is None else _unpack(next(a for a in arguments if a is not type(None)), packed, file)
    if hint is np.ndarray or origin is np.ndarray:
        return _read_array(packed, file)
    if getattr(hint, "__name__", "") == "Tensor":
        import torch

        return torch.from_numpy(_read_array(packed, file))
    return hint(packed) if isinstance(hint, type) and issubclass(hint, Enum) else packed


def _read_array(packed: Any, file: io.BufferedIOBase) -> np.ndarray:
    dtype, shape, is_transposed, writeable, checksum = packed
    size = math.prod(shape)
    if size and any(file.read(-file.tell() % _ALIGNMENT)):
        raise ValueError("damaged")
    if size and not writeable and isinstance(file, _Memory):
        array = file.view(shape, np.dtype(dtype))
    else:
        array = np.empty(shape, np.dtype(dtype))
        if file.readinto(array.reshape(-1).view(np.uint8).data) != array.nbytes:
            raise ValueError("damaged")
    if zlib.crc32(array.reshape(-1).view(np.uint8).data) != checksum:
        raise ValueError("damaged")
    array = array.T if is_transposed else array
    array.flags.writeable = writeable
    return array


@lru_cache(maxsize=256)
def _hints_of(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _field_names(kind: Any) -> tuple[str, ...]:
    """Names of the fields of a dataclass or a named tuple; none of any other type."""
    if is_dataclass(kind):
        return tuple(f.name for f in fields(kind))
    return getattr(kind, "_fields", ()) if isinstance(kind, type) else ()
