# SPDX-License-Identifier: Apache-2.0
"""Numbers and tables to bytes and back: varints, sets of cells, quantised features, logarithmic codes. No weights.

All functions work on whole numpy arrays; what is not a proper encoding is a :class:`PacketError`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F32x1, F32x2, I64x1, Int64, U8x1, njit
from manyeyes.datatypes import WireError

Reason = Literal["garbage", "version", "checksum", "implausible", "contradiction", "wrong_model"]

DELTA, BITMAP = 0, 1
"""How a set of cells is written: gaps between sorted keys, or one bit a cell over the span of keys."""

VARINT_BYTES = 5
"""Most bytes of a varint."""
_STEPS_PER_OCTAVE = 8
_FIRST_OCTAVE = -16


class PacketError(WireError):
    """A packet that is rejected; ``reason`` is the kind of fault."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason: Reason = reason


def pack_varints(values: NDArray[np.int64]) -> bytes:
    """Little-endian base-128 of values (N,) in [0, 2^35): seven bits a byte, the top bit is set if more follow."""
    out = np.empty(len(values) * VARINT_BYTES, np.uint8)
    used = _write_varints(np.ascontiguousarray(values, np.int64), out)
    if used < 0:
        raise WireError("A varint holds values from 0 to 2^35 - 1; send a smaller grid.")
    return out[:used].tobytes()


@njit(cache=True)
def _write_varints(values: I64x1, out: U8x1) -> int:  # pragma: no cover
    """Return bytes written to out; -1 where a value does not fit."""
    at = 0
    for value in values:
        if value < 0 or value >> 35:
            return -1
        at = _write_varint(int(value), out, at)
    return at


@njit(cache=True)
def _write_varint(value: int, out: U8x1, at: int) -> int:  # pragma: no cover
    """Return the place in out after the value that was written from at on."""
    while value >> 7:
        out[at] = value & 127 | 128
        value >>= 7
        at += 1
    out[at] = value
    return at + 1


def unpack_varints(data: bytes, count: int) -> tuple[NDArray[np.int64], int]:
    """Return the first ``count`` varints of data, and how many bytes they took. Padded (non-shortest) forms are refused."""
    _check_room(count, len(data))
    values = np.zeros(count, np.int64)
    used, whole = _read_varints(np.frombuffer(data, np.uint8), values)
    _check_varints(used, whole, count)
    return values, used


def _check_room(count: int, max_count: int) -> None:
    """Refuse a count of values that these bytes cannot hold, before anything is allocated for it."""
    if count > max_count:
        raise PacketError("garbage", f"{count} values were announced; the bytes hold {max_count} at most.")


def _check_varints(used: int, whole: int, count: int) -> None:
    if used < 0:
        raise PacketError("garbage", f"A varint has at most {VARINT_BYTES} bytes and no padding.")
    if whole < count:
        raise PacketError("garbage", f"Expected {count} varints; the bytes end after {whole}.")


@njit(cache=True)
def _read_varints(raw: U8x1, values: I64x1) -> tuple[int, int]:  # pragma: no cover
    """Return bytes read, -1 where one is too long or padded, and how many values are whole."""
    at = 0
    for i in range(values.shape[0]):
        value, shift = 0, 0
        while True:
            if at == raw.shape[0]:
                return at, i
            byte = np.int64(raw[at])
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
            if shift == 35:
                return -1, i
        if byte == 0 and shift > 7:
            return -1, i
        values[i] = value
    return at, values.shape[0]


@njit(cache=True)
def _sizes(key: I64x1) -> tuple[int, int]:  # pragma: no cover
    """Return bytes of sorted keys as gaps and as a bitmap."""
    gaps, before = 0, -1
    for k in key:
        gaps += _varint_bytes(k - before - 1)
        before = k
    span = (key[-1] - key[0]) // 8 + 1
    return gaps, _varint_bytes(key[0]) + _varint_bytes(span) + span


@njit(cache=True)
def _varint_bytes(value: Int64) -> int:  # pragma: no cover
    size = 1
    while value >> 7:
        value >>= 7
        size += 1
    return size


def cells_size(key: NDArray[np.int64]) -> int:
    """Return bytes of :func:`pack_cells` for sorted keys (N,); a further key lowers it by at most one byte (a shorter start)."""
    return min(_sizes(key)) if key.size else 0


@njit(cache=True)
def count_fitting_cells(
    key: I64x1, bytes_per_cell: int, fixed_bytes: int, capacity: int, header_bytes: int, bytes_left: int
) -> I64x1:  # pragma: no cover
    """Return how many keys (N,), in the order given, each body takes: its cells, each bytes a cell, and fixed bytes.

    A body has at most capacity bytes and, where left is not negative, all bodies with their headers at most left.
    """
    widest = 0
    for k in key:
        widest = max(widest, _varint_bytes(int(k)))
    counts, bodies, at = np.empty(key.shape[0], np.int64), 0, 0
    while at < key.shape[0]:
        room = max(0, (capacity if bytes_left < 0 else min(capacity, bytes_left - header_bytes)) - fixed_bytes)
        max_count = min(key.shape[0] - at, 65535)
        low, high = min(max_count, room // (bytes_per_cell + widest)), min(max_count, room // bytes_per_cell)
        while low < high:
            middle = (low + high + 1) // 2
            size = middle * bytes_per_cell + min(_sizes(np.sort(key[at : at + middle])))
            if size <= room:
                low = middle
            else:
                high = middle - 1
        if low == 0:
            break
        if bytes_left >= 0:
            bytes_left -= header_bytes + fixed_bytes + low * bytes_per_cell + min(_sizes(np.sort(key[at : at + low])))
        counts[bodies] = low
        bodies += 1
        at += low
    return counts[:bodies]


def pack_cells(key: NDArray[np.int64]) -> tuple[int, bytes]:
    """Strictly ascending keys (N,) in the shorter of two forms: (DELTA or BITMAP, bytes).

    DELTA: varints of the first key and of each further gap less one. BITMAP: varints of the first key and of the
    number of bytes that follow, then one bit a key from the first to the last, lowest bit first.
    """
    return pack_cell_runs(key, [len(key)])[0]


def pack_cell_runs(key: NDArray[np.int64], counts: list[int]) -> list[tuple[int, bytes]]:
    """:func:`pack_cells` of each run of keys (N,), which ascend within a run; counts: how many keys each run has."""
    if key.size and (int(key.min()) < 0 or int(key.max()) >> 7 * VARINT_BYTES):
        raise WireError("A varint holds values from 0 to 2^35 - 1; send a smaller grid.")
    out = np.empty(len(key) * VARINT_BYTES, np.uint8)
    layouts, ends = np.empty(len(counts), np.uint8), np.empty(len(counts), np.int64)
    _write_cell_runs(np.ascontiguousarray(key, np.int64), np.array(counts, np.int64), out, layouts, ends)
    data, stops = out.tobytes(), ends.tolist()
    return [(layout, data[a:b]) for layout, a, b in zip(layouts.tolist(), [0, *stops], stops)]


@njit(cache=True)
def _write_cell_runs(key: I64x1, counts: I64x1, out: U8x1, layouts: U8x1, ends: I64x1) -> None:  # pragma: no cover
    """Fills out with the bytes of all runs, layouts with their forms and ends with where each ends."""
    at, first = 0, 0
    for run in range(counts.shape[0]):
        cells = key[first : first + counts[run]]
        first += counts[run]
        layouts[run] = DELTA
        if cells.shape[0]:
            as_gaps, as_bitmap = _sizes(cells)
            if as_gaps <= as_bitmap:
                before = -1
                for k in cells:
                    at = _write_varint(k - before - 1, out, at)
                    before = k
            else:
                layouts[run] = BITMAP
                span = (cells[-1] - cells[0]) // 8 + 1
                at = _write_varint(span, out, _write_varint(cells[0], out, at))
                out[at : at + span] = 0
                for k in cells:
                    bit = k - cells[0]
                    out[at + bit // 8] |= 1 << bit % 8
                at += span
        ends[run] = at


def unpack_cells(layout: int, data: bytes, count: int) -> tuple[NDArray[np.int64], int]:
    """Return the inverse of :func:`pack_cells`: ascending keys (count,) and how many bytes of data they took."""
    _check_room(count, len(data) if layout == DELTA else 8 * len(data))
    key, raw = np.empty(count, np.int64), np.frombuffer(data, np.uint8)
    if layout == DELTA:
        used, whole = _read_gaps(raw, key)
        _check_varints(used, whole, count)
        return key, used
    head = np.empty(2, np.int64)
    used, whole = _read_varints(raw, head)
    _check_varints(used, whole, 2)
    first, span = head.tolist()
    if used + span > len(data):
        raise PacketError("garbage", f"A bitmap of {span} bytes was announced; {len(data) - used} are there.")
    marked = _read_bitmap(raw, used, used + span, first, key)
    if marked != count:
        raise PacketError("garbage", f"A bitmap for {count} cells was announced; it marks {marked}.")
    return key, used + span


@njit(cache=True)
def _read_gaps(raw: U8x1, key: I64x1) -> tuple[int, int]:  # pragma: no cover
    """As :func:`_read_varints`, and the gaps added up to keys."""
    used, whole = _read_varints(raw, key)
    before = -1
    for i in range(key.shape[0]):
        before += key[i] + 1
        key[i] = before
    return used, whole


@njit(cache=True)
def _read_bitmap(raw: U8x1, start: int, end: int, first: int, key: I64x1) -> int:  # pragma: no cover
    """Return how many bits are set from start to end; as many of their keys as there is room for."""
    marked = 0
    for i in range(end - start):
        byte = raw[start + i]
        for bit in range(8):
            if byte >> bit & 1:
                if marked < key.shape[0]:
                    key[marked] = first + 8 * i + bit
                marked += 1
    return marked


@njit(cache=True)
def mark_new(bitmap: U8x1, key: I64x1) -> bool:  # pragma: no cover
    """Set the bits of keys (N,) in a bitmap, lowest bit first; nothing is set, and False returned, where one of them is set."""
    for k in key:
        if bitmap[k >> 3] >> (k & 7) & 1:
            return False
    for k in key:
        bitmap[k >> 3] |= 1 << (k & 7)
    return True


def are_finite(data: bytes, at: int, size: int) -> bool:
    """Return whether the little-endian floats of size bytes, 2 or 4, that data holds from at on are neither NaN nor infinite."""
    return bool(_are_finite(np.frombuffer(data, np.uint8), at, size))


@njit(cache=True)
def _are_finite(raw: U8x1, at: int, size: int) -> bool:  # pragma: no cover
    bad = False
    if size == 2:
        for i in range((raw.shape[0] - at) // 2):
            bad |= raw[at + 2 * i + 1] & 0x7C == 0x7C
    else:
        for i in range((raw.shape[0] - at) // 4):
            bad |= (raw[at + 4 * i + 3] & 0x7F == 0x7F) and raw[at + 4 * i + 2] & 0x80 == 0x80
    return not bad


@njit(cache=True)
def are_floats_within(raw: U8x1, size: int, bounds: I64x1) -> bool:  # pragma: no cover
    """Return whether rows of little-endian floats of size bytes, 2 or 4, none of them NaN, are within the bounds of their columns.

    bounds: (C,) the bits of the bounds. Without their signs, the bits of floats are in the order of their values.
    """
    columns, column, top, num_beyond = bounds.shape[0], 0, size - 1, 0
    for at in range(0, raw.shape[0], size):
        bits = np.int64(raw[at + top] & 0x7F)
        for k in range(top - 1, -1, -1):
            bits = bits << 8 | np.int64(raw[at + k])
        num_beyond += bits > bounds[column]
        column += 1
        if column == columns:
            column = 0
    return num_beyond == 0


@njit(cache=True)
def are_steps_within(raw: U8x1, codes: U8x1, bounds: I64x1) -> bool:  # pragma: no cover
    """Return the same of rows of int8; codes: (C,) scales of the columns; bounds: (256, C), flat, the largest step by scale."""
    columns, column, num_beyond = codes.shape[0], 0, 0
    for at in range(raw.shape[0]):
        step = np.int64(raw[at])
        step = 256 - step if step > 127 else step
        num_beyond += step > bounds[codes[column] * columns + column]
        column += 1
        if column == columns:
            column = 0
    return num_beyond == 0


def _scales() -> NDArray[np.float32]:
    # Eighths of an octave times an exact power of two: the same table on every machine.
    steps = [math.ldexp(2.0 ** (k % 8 / 8), _FIRST_OCTAVE + k // 8) for k in range(255)]
    return np.array([0.0, *steps], np.float32)


SCALES: NDArray[np.float32] = _scales()
"""(256,) what the largest magnitude of a channel is rounded up to: 0, then 2^-16 … 2^15.75 in steps of 9 %."""


def quantise_int8(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
    """Return features (N, C) as scale codes (C,) and steps (N, C) of SCALES[code] / 127; the error is half a step at most.

    One byte a channel instead of a float: the step is at most 9 % coarser than the ideal one.
    """
    codes, steps = quantise_int8_runs(values, [len(values)])
    return codes[0], steps


def quantise_int8_runs(values: NDArray[np.float32], counts: list[int]) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
    """:func:`quantise_int8` of each run of rows (N, C): codes (runs, C), steps (N, C). counts: the rows of each run.

    A run is empty only where it is the only one.
    """
    peak = np.zeros((len(counts), values.shape[1]), np.float32)
    if len(values):
        peak = np.maximum.reduceat(np.abs(values), np.cumsum([0, *counts[:-1]]))
    code = np.searchsorted(SCALES, peak)
    if code.size and int(code.max()) > 255:
        raise WireError(f"int8 features reach {SCALES[-1]:.0f}; got {float(peak.max()):g}; send float32.")
    step = np.repeat(SCALES[code] / np.float32(127), counts, axis=0)
    quantised = np.rint(np.divide(values, step, out=np.zeros_like(values), where=step > 0))
    return code.astype(np.uint8), np.clip(quantised, -127, 127).astype(np.int8)


def dequantise_int8(code: NDArray[np.uint8], steps: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return features (N, C) float32 from scale codes (C,), or (N, C) of each row, and steps (N, C)."""
    step = (SCALES[code] / np.float32(127)).astype(np.float32)
    return steps.astype(np.float32) * step


def log_codes(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    """Quantise values to 0 … 255: 0 is exactly 0, 1 … 255 are equal ratios from low to high; what lies outside saturates."""
    ratio = np.log(np.maximum(values, low) / low) / math.log(high / low)
    return np.where(values > 0, 1 + np.rint(np.clip(ratio, 0, 1) * 254), 0).astype(np.uint8)


def log_values(codes: NDArray[np.uint8], low: float, high: float) -> NDArray[np.float32]:
    """Return the inverse of :func:`log_codes`, within half a step of the logarithm."""
    exponent = (np.maximum(codes, 1).astype(np.float64) - 1) / 254
    return np.where(codes > 0, low * (high / low) ** exponent, 0.0).astype(np.float32)


def are_within(values: NDArray[np.float32], bounds: NDArray[np.floating]) -> bool:
    """Return whether the magnitudes of values (N, C) are at most the bounds (C,); NaN is within no bound."""
    return bool(_are_within(values, np.asarray(bounds, np.float32)))


@njit(cache=True)
def _are_within(values: F32x2, bounds: F32x1) -> bool:  # pragma: no cover
    for i in range(values.shape[0]):
        outside = 0
        for c in range(values.shape[1]):
            outside += not abs(values[i, c]) <= bounds[c]
        if outside:
            return False
    return True
