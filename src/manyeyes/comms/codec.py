# SPDX-License-Identifier: Apache-2.0
"""Numbers and tables to bytes and back: varints, sets of cells, quantised features, logarithmic codes. No weights.

All functions work on whole numpy arrays; what is not a proper encoding is a :class:`PacketError`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from manyeyes.datatypes import WireError

Reason = Literal["garbage", "version", "checksum", "implausible", "contradiction"]

DELTA, BITMAP = 0, 1
"""How a set of cells is written: gaps between sorted keys, or one bit a cell over the span of keys."""

_VARINT_BYTES = 5
_VARINT_LIMITS = 1 << 7 * np.arange(1, _VARINT_BYTES)
_STEPS_PER_OCTAVE = 8
_FIRST_OCTAVE = -16


class PacketError(WireError):
    """A packet that is refused; ``reason`` says of what kind the fault is."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason: Reason = reason


def varint_sizes(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bytes that each of the values (N,) in [0, 2^35) takes as a varint."""
    return np.searchsorted(_VARINT_LIMITS, values, side="right") + 1


def pack_varints(values: NDArray[np.int64]) -> bytes:
    """Little-endian base-128 of values (N,) in [0, 2^35): seven bits a byte, the top bit says that more follow."""
    out = np.empty(len(values) * _VARINT_BYTES, np.uint8)
    used = _write_varints(np.ascontiguousarray(values, np.int64), out)
    if used < 0:
        raise WireError("A varint holds values from 0 to 2^35 - 1; send a smaller grid.")
    return out[:used].tobytes()


@njit(cache=True)
def _write_varints(values, out):  # pragma: no cover
    """Bytes written to out; -1 where a value does not fit."""
    at = 0
    for value in values:
        if value < 0 or value >> 35:
            return -1
        while value >> 7:
            out[at] = value & 127 | 128
            value >>= 7
            at += 1
        out[at] = value
        at += 1
    return at


def unpack_varints(data: bytes, count: int) -> tuple[NDArray[np.int64], int]:
    """The first ``count`` varints of data, and how many bytes they took. Padded (non-shortest) forms are refused."""
    values = np.zeros(count, np.int64)
    used, whole = _read_varints(np.frombuffer(data, np.uint8), values)
    if whole < count and used >= 0:
        raise PacketError("garbage", f"Expected {count} varints; the bytes end after {whole}.")
    if used < 0:
        raise PacketError("garbage", f"A varint has at most {_VARINT_BYTES} bytes and no padding.")
    return values, used


@njit(cache=True)
def _read_varints(raw, values):  # pragma: no cover
    """Bytes read, -1 where one is too long or padded, and how many values are whole."""
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


def _gaps(key: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate((key[:1], np.diff(key) - 1))


@njit(cache=True)
def _sizes(key):  # pragma: no cover
    """Bytes of sorted keys as gaps and as a bitmap."""
    gaps, before = 0, -1
    for k in key:
        gaps += _varint_bytes(k - before - 1)
        before = k
    span = (key[-1] - key[0]) // 8 + 1
    return gaps, _varint_bytes(key[0]) + _varint_bytes(span) + span


@njit(cache=True)
def _varint_bytes(value):  # pragma: no cover
    size = 1
    while value >> 7:
        value >>= 7
        size += 1
    return size


def _span_bytes(key: NDArray[np.int64]) -> int:
    return int(key[-1] - key[0]) // 8 + 1


def cells_size(key: NDArray[np.int64]) -> int:
    """Bytes of :func:`pack_cells` for sorted keys (N,); a further key lowers it by at most one byte (a shorter start)."""
    return min(_sizes(key)) if key.size else 0


@njit(cache=True)
def counts_in_room(key, each, fixed, capacity, header, left):  # pragma: no cover
    """How many keys (N,), in the order given, each body takes: its cells, each bytes a cell, and fixed bytes.

    A body has at most capacity bytes and, where left is not negative, all bodies with their headers at most left.
    """
    widest = 0
    for k in key:
        widest = max(widest, _varint_bytes(k))
    counts, bodies, at = np.empty(key.shape[0], np.int64), 0, 0
    while at < key.shape[0]:
        room = max(0, (capacity if left < 0 else min(capacity, left - header)) - fixed)
        most = min(key.shape[0] - at, 65535)
        low, high = min(most, room // (each + widest)), min(most, room // each)
        while low < high:
            middle = (low + high + 1) // 2
            size = middle * each + min(_sizes(np.sort(key[at : at + middle])))
            if size <= room:
                low = middle
            else:
                high = middle - 1
        if low == 0:
            break
        if left >= 0:
            left -= header + fixed + low * each + min(_sizes(np.sort(key[at : at + low])))
        counts[bodies] = low
        bodies += 1
        at += low
    return counts[:bodies]


def pack_cells(key: NDArray[np.int64]) -> tuple[int, bytes]:
    """Strictly ascending keys (N,) in the shorter of two forms: (DELTA or BITMAP, bytes).

    DELTA: varints of the first key and of each further gap less one. BITMAP: varints of the first key and of the
    number of bytes that follow, then one bit a key from the first to the last, lowest bit first.
    """
    if not key.size:
        return DELTA, b""
    as_gaps, as_bitmap = _sizes(key)
    if as_gaps <= as_bitmap:
        return DELTA, pack_varints(_gaps(key))
    span = _span_bytes(key)
    bits = np.zeros(span * 8, np.uint8)
    bits[key - key[0]] = 1
    head = pack_varints(np.array([key[0], span], np.int64))
    return BITMAP, head + np.packbits(bits, bitorder="little").tobytes()


def unpack_cells(layout: int, data: bytes, count: int) -> tuple[NDArray[np.int64], int]:
    """The inverse of :func:`pack_cells`: ascending keys (count,) and how many bytes of data they took."""
    if layout == DELTA:
        gaps, used = unpack_varints(data, count)
        return np.cumsum(gaps + 1) - 1, used
    (first, span), used = unpack_varints(data, 2)
    end = used + int(span)
    if end > len(data):
        raise PacketError("garbage", f"A bitmap of {int(span)} bytes was announced; {len(data) - used} are there.")
    bits = np.unpackbits(np.frombuffer(data, np.uint8, count=int(span), offset=used), bitorder="little")
    key = np.flatnonzero(bits).astype(np.int64) + first
    if key.size != count:
        raise PacketError("garbage", f"A bitmap for {count} cells was announced; it marks {key.size}.")
    return key, end


def _scales() -> NDArray[np.float32]:
    # Eighths of an octave times an exact power of two: the same table on every machine.
    steps = [math.ldexp(2.0 ** (k % 8 / 8), _FIRST_OCTAVE + k // 8) for k in range(255)]
    return np.array([0.0, *steps], np.float32)


SCALES: NDArray[np.float32] = _scales()
"""(256,) what the largest magnitude of a channel is rounded up to: 0, then 2^-16 … 2^15.75 in steps of 9 %."""


def quantise_int8(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
    """Features (N, C) as scale codes (C,) and steps (N, C) of SCALES[code] / 127; the error is half a step at most.

    One byte a channel instead of a float: the step is at most 9 % coarser than the ideal one.
    """
    peak = np.abs(values).max(0) if len(values) else np.zeros(values.shape[1], np.float32)
    code = np.searchsorted(SCALES, peak)
    if code.size and int(code.max()) > 255:
        raise WireError(f"int8 features reach {SCALES[-1]:.0f}; got {float(peak.max()):g}; send float32.")
    step = SCALES[code] / np.float32(127)
    quantised = np.rint(np.divide(values, step, out=np.zeros_like(values), where=step > 0))
    return code.astype(np.uint8), np.clip(quantised, -127, 127).astype(np.int8)


def dequantise_int8(code: NDArray[np.uint8], steps: NDArray[np.int8]) -> NDArray[np.float32]:
    """Features (N, C) float32 from scale codes (C,) and steps (N, C)."""
    step = (SCALES[code] / np.float32(127)).astype(np.float32)
    return steps.astype(np.float32) * step


def log_codes(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    """Values to 0 … 255: 0 is exactly 0, 1 … 255 are equal ratios from low to high; what lies outside saturates."""
    ratio = np.log(np.maximum(values, low) / low) / math.log(high / low)
    return np.where(values > 0, 1 + np.rint(np.clip(ratio, 0, 1) * 254), 0).astype(np.uint8)


def log_values(codes: NDArray[np.uint8], low: float, high: float) -> NDArray[np.float32]:
    """The inverse of :func:`log_codes`, within half a step of the logarithm."""
    exponent = (np.maximum(codes, 1).astype(np.float64) - 1) / 254
    return np.where(codes > 0, low * (high / low) ** exponent, 0.0).astype(np.float32)
