# SPDX-License-Identifier: Apache-2.0
"""LZF, the compression of ``DATA binary_compressed`` in PCD files (format: liblzf's description)."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import njit

_OVERRUN = -1
# How far back a copy may reach, and how many bytes it may hold: 13 bits, and 3 + 8 bits of length on top of 2.
_MAX_OFFSET = 8192
_MAX_LENGTH = 264


@njit(cache=True)
def _expand(packed: np.ndarray, out: np.ndarray) -> int:
    """Fill ``out`` from ``packed``; the number of bytes written, or -1 where the stream points outside its bounds."""
    read, written = 0, 0
    while read < packed.size:
        control = int(packed[read])
        read += 1
        if control < 32:  # a run of literal bytes
            count = control + 1
            if read + count > packed.size or written + count > out.size:
                return _OVERRUN
            for i in range(count):
                out[written + i] = packed[read + i]
            read += count
        else:  # a copy of earlier output; source and target may overlap, so byte by byte
            count = control >> 5
            if count == 7:
                if read >= packed.size:
                    return _OVERRUN
                count += int(packed[read])
                read += 1
            count += 2
            if read >= packed.size:
                return _OVERRUN
            start = written - ((control & 31) << 8) - int(packed[read]) - 1
            read += 1
            if start < 0 or written + count > out.size:
                return _OVERRUN
            for i in range(count):
                out[written + i] = out[start + i]
        written += count
    return written


def lzf_decompress(packed: bytes | memoryview, size: int) -> bytes | None:
    """Return the ``size`` bytes that ``packed`` stands for, or None where it is damaged or has another length."""
    out = np.empty(size, np.uint8)
    return out.tobytes() if _expand(np.frombuffer(packed, np.uint8), out) == size else None


@njit(cache=True)
def _shrink(plain: np.ndarray, out: np.ndarray) -> int:
    """Fill ``out`` with the stream of ``plain``; the number of bytes written. Matches are found by a table of three bytes."""
    size, written = plain.size, 0
    last = np.full(1 << 16, -_MAX_OFFSET - 1, np.int64)
    at, start = 0, 0  # start: the first literal that is not written yet
    while at < size:
        length, before = 0, 0
        if at + 2 < size:
            key = (plain[at] * 506832829 ^ plain[at + 1] * 2654435761 ^ plain[at + 2] * 40503) & 0xFFFF
            before = last[key]
            last[key] = at
            if at - before <= _MAX_OFFSET:
                while length < _MAX_LENGTH and at + length < size and plain[before + length] == plain[at + length]:
                    length += 1
        if length < 3:
            at += 1
            continue
        written = _literals(plain, start, at, out, written)
        distance, count = at - before - 1, length - 2
        if count < 7:
            out[written] = count << 5 | distance >> 8
        else:
            out[written] = 7 << 5 | distance >> 8
            out[written + 1] = count - 7
            written += 1
        out[written + 1] = distance & 255
        written += 2
        at += length
        start = at
    return _literals(plain, start, size, out, written)


@njit(cache=True)
def _literals(plain: np.ndarray, start: int, end: int, out: np.ndarray, written: int) -> int:
    """Append the bytes start … end as runs of at most 32; the new number of bytes written."""
    while start < end:
        count = min(32, end - start)
        out[written] = count - 1
        for i in range(count):
            out[written + 1 + i] = plain[start + i]
        written += count + 1
        start += count
    return written


def lzf_compress(plain: bytes | memoryview) -> bytes:
    """Return a stream that :func:`lzf_decompress` unpacks to ``plain``; at most 1/32 longer, the same every time."""
    source = np.frombuffer(plain, np.uint8)
    out = np.empty(source.size + source.size // 32 + 1, np.uint8)
    return out[: _shrink(source, out)].tobytes()
