# SPDX-License-Identifier: Apache-2.0
"""Point Cloud Data files, version 0.7: ascii, binary and binary_compressed in, the last two out.

Points are given in the file's own frame: which axes and which hand that is, the reader of the recording knows.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manyeyes._io import atomic_write, read_file
from manyeyes.datasets.formats.cache import ArrayCache
from manyeyes.datatypes import RecordingError

_KINDS = {"F": "f", "U": "u", "I": "i"}
_LETTERS = {kind: letter for letter, kind in _KINDS.items()}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_REMEDY = "copy or download the file again"
_MAX_POINT_BYTES = 4096
_MAX_CLOUD_BYTES = 1 << 30


@dataclass(frozen=True)
class PcdTable:
    """The columns of a file as they stand in it: names[i] belongs to columns[i], each (N,) or (N, count)."""

    names: tuple[str, ...]
    columns: tuple[np.ndarray, ...]

    def column(self, name: str) -> np.ndarray | None:
        """Return the column of that name, or None where the file has no such field."""
        return self.columns[self.names.index(name)] if name in self.names else None


@dataclass(frozen=True)
class PcdCloud:
    """xyz: (N, 3) float32, metres; intensity: (N,) float32 in [0, 1]; time_s: (N,) float64, where the file has it."""

    xyz: np.ndarray
    intensity: np.ndarray
    time_s: np.ndarray | None = None


@dataclass(frozen=True)
class _PcdHeader:
    names: tuple[str, ...]
    dtypes: tuple[np.dtype, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str

    @property
    def record(self) -> np.dtype:
        """One point of ``DATA binary``; fields are named by position, because padding repeats the name ``_``."""
        return np.dtype(
            [(str(i), d, (c,)) if c > 1 else (str(i), d) for i, (d, c) in enumerate(zip(self.dtypes, self.counts))]
        )


def read_pcd(path: Path, drop_nan: bool = False, cache: ArrayCache | None = None) -> PcdCloud:
    """Read a cloud; ``rgb`` gives intensity as red / 255, an integer intensity is divided by its type's largest value.

    A float intensity stands for itself, unless any value exceeds 1: then the file counts to 255. NaN points are an
    error unless drop_nan. With a cache, ascii files are parsed once and kept as float32 arrays.
    """
    header, body = _read(path)
    # Binary files are read faster than the cache is asked.
    is_slow = header.encoding == "ascii"
    kept = cache.load(path, "pcd") if cache is not None and is_slow else None
    if kept is not None:
        cloud = PcdCloud(np.ascontiguousarray(kept[:, :3]), np.ascontiguousarray(kept[:, 3]))
    else:
        cloud = _cloud(path, _parse_body(path, header, body))
        if cache is not None and is_slow and cloud.time_s is None:
            cache.store(path, "pcd", np.concatenate((cloud.xyz, cloud.intensity[:, None]), 1))
    # The sum is a cheap first check: it is finite where every point is.
    if np.isfinite(cloud.xyz.sum(dtype=np.float64)):
        return cloud
    whole = np.asarray(np.isfinite(cloud.xyz).all(axis=1))
    if not drop_nan:
        raise RecordingError(
            f"{path}: {int((~whole).sum())} of {len(whole)} points are NaN or infinite, expected none; "
            "read with drop_nan=True to leave them out."
        )
    return PcdCloud(cloud.xyz[whole], cloud.intensity[whole], None if cloud.time_s is None else cloud.time_s[whole])


def read_table(path: Path) -> PcdTable:
    """Read every field of a file, unchanged in type and unit."""
    return _parse_body(path, *_read(path))


def write_pcd(path: Path, xyz: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) and intensities (N,) in [0, 1] with OPV2V's fields ``x y z rgb``: 8 bits of red, binary."""
    n = len(xyz)
    record = np.empty((n, 4), "<u4")
    record[:, :3] = np.ascontiguousarray(xyz, "<f4").view("<u4")
    record[:, 3] = np.rint(np.clip(intensity, 0, 1) * 255).astype("<u4") << 16
    _write_four(path, "x y z rgb", record.tobytes(), n)


def write_float_pcd(path: Path, xyz: np.ndarray, intensity: np.ndarray) -> None:
    """Write points (N, 3) and intensities (N,) in [0, 1] as ``x y z intensity``: float32, binary."""
    record = np.column_stack((xyz, np.clip(intensity, 0, 1))).astype("<f4")
    _write_four(path, "x y z intensity", record.tobytes(), len(record))


def _write_four(path: Path, fields: str, body: bytes, n: int) -> None:
    """Write n points of four fields of four bytes."""
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    atomic_write(path, header.encode(), body, durable=False)


def write_table(path: Path, table: PcdTable) -> None:
    """Write every field (N,) in its own type, one field after the other, as ``DATA binary_compressed``."""
    from manyeyes.datasets.formats.lzf import lzf_compress

    columns = [np.ascontiguousarray(c, c.dtype.newbyteorder("<")) for c in table.columns]
    sizes = {c.shape for c in columns}
    if len(sizes) != 1 or len(next(iter(sizes))) != 1 or len(columns) != len(table.names):
        raise RecordingError(
            f"{path}: expected one column (N,) for each of {' '.join(table.names)}; got shapes "
            f"{', '.join(str(c.shape) for c in columns)}: give columns of one length."
        )
    plain = b"".join(c.tobytes() for c in columns)
    packed = lzf_compress(plain) if plain else b""
    n = len(columns[0])
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {' '.join(table.names)}\n"
        f"SIZE {' '.join(str(c.dtype.itemsize) for c in columns)}\n"
        f"TYPE {' '.join(_LETTERS[c.dtype.kind] for c in columns)}\nCOUNT {' '.join('1' for _ in columns)}\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary_compressed\n"
    )
    atomic_write(path, header.encode(), np.array([len(packed), len(plain)], "<u4").tobytes(), packed, durable=False)


def _read(path: Path) -> tuple[_PcdHeader, memoryview]:
    """Return the header of a file, and what follows it."""
    try:
        data = read_file(path)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file, expected a PCD point cloud; {_REMEDY}.") from None
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read ({error.strerror}), expected a PCD point cloud; {_REMEDY}."
        ) from None
    header, start = _parse_header(path, data)
    return header, memoryview(data)[start:]


def _parse_body(path: Path, header: _PcdHeader, body: memoryview) -> PcdTable:
    parse = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.encoding]
    return parse(path, header, body)


def _parse_header(path: Path, data: bytes) -> tuple[_PcdHeader, int]:
    """Return the header and the offset of the first byte after its DATA line."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start, start + 65536)
        if end < 0:
            found = f"found {len(data)} bytes without one"
            raise RecordingError(f"{path}: expected a PCD header that ends with a DATA line, {found}; {_REMEDY}.")
        words = data[start:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
        start = end + 1
    try:
        names, sizes, kinds = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
        counts = tuple(int(c) for c in entries.get("COUNT", ["1"] * len(names)))
        dtypes = tuple(np.dtype(f"<{_KINDS[k]}{s}") for k, s in zip(kinds, sizes))
        points = (
            int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
        )
        encoding = entries["DATA"][0]
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise RecordingError(f"{path}: the PCD header's {error} is missing or unknown; {_REMEDY}.") from None
    point_bytes = sum(max(d.itemsize, 1) * c for d, c in zip(dtypes, counts))
    if min(counts, default=1) < 1 or point_bytes > _MAX_POINT_BYTES or points * point_bytes > _MAX_CLOUD_BYTES:
        raise RecordingError(
            f"{path}: the PCD header's COUNT {' '.join(map(str, counts))[:80]} and POINTS {points} give {point_bytes} bytes a "
            f"point; expected counts from 1, at most {_MAX_POINT_BYTES:,} bytes a point and {_MAX_CLOUD_BYTES:,} in all; "
            f"{_REMEDY}."
        )
    if not len(names) == len(dtypes) == len(counts) or points < 0 or encoding not in _ENCODINGS:
        got = f"{len(names)} FIELDS, {len(dtypes)} TYPE and SIZE, {len(counts)} COUNT, {points} POINTS, DATA {encoding}"
        raise RecordingError(f"{path}: the PCD header contradicts itself or PCD 0.7: {got}; {_REMEDY}.")
    return _PcdHeader(tuple(names), dtypes, counts, points, encoding), start


def _truncated(path: Path, unit: str, expected: int, found: int) -> RecordingError:
    word = "truncated" if found < expected else "damaged"
    return RecordingError(f"{path}: {word}, expected {expected} {unit} by its header, found {found}; {_REMEDY}.")


def _ascii(path: Path, header: _PcdHeader, body: memoryview) -> PcdTable:
    width = sum(header.counts)
    text = bytes(body)
    lines = sum(1 for line in text.splitlines() if line.strip())
    if lines != header.points:
        raise _truncated(path, "lines of points", header.points, lines)
    if not lines:
        return PcdTable(header.names, tuple(np.empty(0, d) for d in header.dtypes))
    try:
        # float64 holds every 4-byte value, and keeps packed colours, which are denormal as float32, from being flushed.
        values = np.loadtxt(io.BytesIO(text), np.float64, comments=None, ndmin=2)
    except ValueError as error:
        reason = str(error).split(";")[0]
        raise RecordingError(
            f"{path}: expected {width} numbers on each of {lines} lines ({reason}); {_REMEDY}."
        ) from None
    if values.shape[1] != width:
        raise _truncated(path, "numbers a line", width, values.shape[1])
    columns, at = [], 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts):
        part = values[:, at] if count == 1 else values[:, at : at + count]
        columns.append(_colour_bits(part).view("<f4") if _is_colour(name, dtype) else part.astype(dtype))
        at += count
    return PcdTable(header.names, tuple(columns))


def _is_colour(name: str, dtype: np.dtype) -> bool:
    return name in ("rgb", "rgba") and dtype == np.dtype("<f4")


def _colour_bits(values: np.ndarray) -> np.ndarray:
    """Return bits (N,) of packed colours given as float64; exact even where the processor flushes float32 denormals to zero.

    Below 2**-125 all float32 are multiples of 2**-149, and the multiple is the bit pattern.
    """
    small = (values >= 0) & (values < 2.0**-125)
    exact = np.rint(np.where(small, values, 0.0) * 2.0**149).astype("<u4")
    return np.where(small, exact, np.where(small, 1.0, values).astype("<f4").view("<u4"))


def _binary(path: Path, header: _PcdHeader, body: memoryview) -> PcdTable:
    size = header.points * header.record.itemsize
    if len(body) < size or bytes(body[size:]).strip(b"\0\r\n "):
        raise _truncated(path, "bytes of points", size, len(body))
    record = np.frombuffer(body[:size], header.record)
    return PcdTable(header.names, tuple(record[str(i)] for i in range(len(header.names))))


def _compressed(path: Path, header: _PcdHeader, body: memoryview) -> PcdTable:
    size = header.points * header.record.itemsize
    if len(body) < 8:
        raise _truncated(path, "bytes of compressed points, at the least,", 8, len(body))
    packed, unpacked = (int(v) for v in np.frombuffer(body[:8], "<u4"))
    if unpacked != size:
        raise _truncated(path, "bytes of uncompressed points", size, unpacked)
    if len(body) - 8 < packed:
        raise _truncated(path, "bytes of compressed points", packed, len(body) - 8)
    from manyeyes.datasets.formats.lzf import (
        lzf_decompress,
    )  # numba is slow to import, and few recordings are compressed

    plain = lzf_decompress(body[8 : 8 + packed], size) if size else b""
    if plain is None:
        raise RecordingError(f"{path}: {packed} compressed bytes do not unpack to the expected {size}; {_REMEDY}.")
    columns, at = [], 0
    for dtype, count in zip(header.dtypes, header.counts):  # one field after the other, not one point after the other
        part = np.frombuffer(plain, dtype, header.points * count, at)
        columns.append(part.reshape(-1, count) if count > 1 else part)
        at += part.nbytes
    return PcdTable(header.names, tuple(columns))


def _cloud(path: Path, table: PcdTable) -> PcdCloud:
    axes = [table.column(name) for name in "xyz"]
    if any(axis is None for axis in axes):
        names = " ".join(table.names)
        raise RecordingError(f"{path}: expected the fields x, y and z, found: {names}; {_REMEDY}.")
    xyz = np.empty((len(table.columns[0]), 3), np.float32)
    for i, axis in enumerate(axes):
        xyz[:, i] = axis
    time = table.column("timestamp")
    time = table.column("time") if time is None else time
    return PcdCloud(xyz, _intensity(table, len(xyz)), None if time is None else time.astype(np.float64))


def _intensity(table: PcdTable, points: int) -> np.ndarray:
    colour = table.column("rgb")
    colour = table.column("rgba") if colour is None else colour
    if colour is not None and colour.dtype.itemsize == 4:
        return (np.ascontiguousarray(colour).view("<u4") >> 16 & 255).astype(np.float32) / np.float32(255)
    stated = table.column("intensity")
    if stated is None:
        return np.zeros(points, np.float32)
    if stated.dtype.kind in "ui":
        return stated.astype(np.float32) / np.float32(np.iinfo(stated.dtype).max)
    stated = stated.astype(np.float32)
    return stated / np.float32(255) if stated.size and np.nanmax(stated) > 1 else stated
