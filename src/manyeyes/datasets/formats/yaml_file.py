# SPDX-License-Identifier: Apache-2.0
"""Yaml files of recordings: plain yaml, and numpy's numbers and arrays as PyYAML writes them; nothing else is constructed.

PyYAML writes a numpy value as a call of a Python object (``!!python/object/apply:numpy...``), which its unsafe loader executes.
Here these tags describe data: a type from a short list, a shape, and base64 bytes whose number must agree with both. Every size
is bounded before memory is taken: merged mappings, elements of an array, and the length of the file. Plain block yaml, which most
files are, is read by lines (``block_yaml``); the loader here is its reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from manyeyes._io import MAX_TEXT_BYTES, read_file
from manyeyes.datasets.formats.block_yaml import parse_block_yaml
from manyeyes.datatypes import RecordingError

REMEDY = "copy or download the file again"
_MAX_MERGED, _MAX_MERGED_ENTRIES = 100, 10_000
_MAX_ELEMENTS, _MAX_AXES, _MAX_ELEMENTS_IN_FILE = 4096, 4, 1 << 20
_PYTHON = "tag:yaml.org,2002:python/"
_NUMPY = tuple(f"{_PYTHON}object/apply:numpy.{core}.multiarray." for core in ("core", "_core"))
_TYPES = ("f8", "f4", "f2", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "b1")


class _UnknownTag(yaml.YAMLError):
    """A tag of Python that stands for no number."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # pyright: ignore[reportGeneralTypeIssues]
    """Safe loader with numpy's numbers, and with a bound on merge keys (<<), which copy: nested ones grow exponentially."""

    num_merged = 0
    num_elements = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge as yaml 1.1 does, up to the bound."""
        merged = [value for key, value in node.value if key.tag == "tag:yaml.org,2002:merge"]
        num_sources = sum(len(value.value) if isinstance(value, yaml.SequenceNode) else 1 for value in merged)
        if num_sources <= _MAX_MERGED:
            super().flatten_mapping(node)
            self.num_merged += len(node.value) if merged else 0
        if num_sources > _MAX_MERGED or self.num_merged > _MAX_MERGED_ENTRIES:
            raise yaml.YAMLError(f"'<<' merges more than {_MAX_MERGED} mappings or {_MAX_MERGED_ENTRIES:,} entries")


def load_yaml(path: Path) -> Mapping[Any, Any]:
    """Return the mapping at the top of a yaml file; aliases are resolved, and numpy's arrays are nested lists of numbers.

    Raises:
        RecordingError: it cannot be read, is no yaml, has a tag that stands for no number, or exceeds a bound.
    """
    try:
        data = read_file(path, MAX_TEXT_BYTES)
        plain = parse_block_yaml(data)
        content = yaml.load(data, _Loader) if plain is None else plain
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}), expected a yaml file; {REMEDY}.") from None
    except _UnknownTag as error:
        raise RecordingError(
            f"{path}: expected plain yaml or numpy's numbers, found {error}; write the file again with plain lists and numbers "
            "(array.tolist(), yaml.safe_dump)."
        ) from None
    except (yaml.YAMLError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path}: expected yaml, found something else ({reason}); {REMEDY}.") from None
    if not isinstance(content, Mapping):
        raise RecordingError(f"{path}: expected a yaml mapping, found {type(content).__name__}; {REMEDY}.")
    return content


def _children(node: yaml.Node, count: int) -> list[yaml.Node]:
    if not isinstance(node, yaml.SequenceNode) or len(node.value) != count:
        raise _UnknownTag(f"a numpy tag without its {count} entries")
    return node.value


def _entries(node: yaml.Node) -> dict[str, yaml.Node]:
    """Return the nodes under ``args`` and ``state`` of a tag that PyYAML wrote as a mapping."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    found = {key.value: value for key, value in pairs if isinstance(key, yaml.ScalarNode)}
    if set(found) != {"args", "state"}:
        raise _UnknownTag("a numpy tag without 'args' and 'state'")
    return found


def _scalar(node: yaml.Node) -> str:
    if not isinstance(node, yaml.ScalarNode):
        raise _UnknownTag("a numpy tag with a list where a value belongs")
    return node.value


def _read_type(node: yaml.Node) -> np.dtype:
    """Return the type that a node ``!!python/object/apply:numpy.dtype`` names."""
    if node.tag != f"{_PYTHON}object/apply:numpy.dtype":
        raise _UnknownTag(f"the tag {node.tag[:80]!r} where a type of numpy belongs")
    entries = _entries(node)
    name, order = _scalar(_children(entries["args"], 3)[0]), _scalar(_children(entries["state"], 8)[1])
    if name not in _TYPES or order not in ("<", ">", "|", "="):
        raise _UnknownTag(f"the numpy type {name[:20]!r}, none of {', '.join(_TYPES)}")
    return np.dtype(f"{'<' if order in '|=' else order}{name}")


def _read_bytes(loader: _Loader, node: yaml.Node, dtype: np.dtype, count: int) -> np.ndarray:
    data = loader.construct_yaml_binary(node) if isinstance(node, yaml.ScalarNode) else b""
    if len(data) != count * dtype.itemsize:
        raise _UnknownTag(f"a numpy value of {len(data)} bytes, not {count} x {dtype.itemsize}")
    return np.frombuffer(data, dtype)


def _construct_number(loader: _Loader, node: yaml.Node) -> float | int | bool:
    """``numpy.core.multiarray.scalar``: a type and the bytes of one number."""
    dtype, data = _children(node, 2)
    return _read_bytes(loader, data, _read_type(dtype), 1)[0].item()


def _construct_array(loader: _Loader, node: yaml.Node) -> Any:
    """``numpy.core.multiarray._reconstruct``: version, shape, type, order of axes, and bytes; nested lists of numbers."""
    _, shape_node, dtype, is_fortran, data = _children(_entries(node)["state"], 5)
    axes = shape_node.value if isinstance(shape_node, yaml.SequenceNode) else []
    sizes = [_scalar(axis) for axis in axes[: _MAX_AXES + 1]]
    if len(sizes) > _MAX_AXES or any(not (size.isascii() and size.isdecimal() and len(size) <= 9) for size in sizes):
        raise _UnknownTag(
            f"a numpy array of shape ({', '.join(size[:20] for size in sizes)}), expected at most {_MAX_AXES} axes"
        )
    shape = tuple(int(size) for size in sizes)
    count = math.prod(max(size, 1) for size in shape)  # an array without numbers may be many empty lists
    loader.num_elements += count
    if count > _MAX_ELEMENTS or loader.num_elements > _MAX_ELEMENTS_IN_FILE:
        raise _UnknownTag(
            f"a numpy array of shape {shape}; the maximum is {_MAX_ELEMENTS:,} numbers, and {_MAX_ELEMENTS_IN_FILE:,} in a file"
        )
    values = _read_bytes(loader, data, _read_type(dtype), math.prod(shape))
    return values.reshape(
        shape, order="F" if _scalar(is_fortran).lower() in ("true", "yes", "on", "y") else "C"
    ).tolist()


def _construct_tuple(loader: _Loader, node: yaml.Node) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


def _refuse(loader: _Loader, suffix: str, node: yaml.Node) -> Any:
    raise _UnknownTag(f"the tag '!!python/{suffix[:80]}'")


_CONSTRUCTORS: tuple[tuple[str, Callable[[_Loader, Any], Any]], ...] = (
    (f"{_PYTHON}tuple", _construct_tuple),
    *((f"{prefix}scalar", _construct_number) for prefix in _NUMPY),
    *((f"{prefix}_reconstruct", _construct_array) for prefix in _NUMPY),
)
for _tag, _constructor in _CONSTRUCTORS:
    _Loader.add_constructor(_tag, _constructor)
_Loader.add_multi_constructor(_PYTHON, _refuse)
