# SPDX-License-Identifier: Apache-2.0
"""LZF decompression, the compression of ``DATA binary_compressed`` in PCD files (format: liblzf's description)."""

from __future__ import annotations

import numpy as np
from numba import njit

_OVERRUN = -1


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
    """The ``size`` bytes that ``packed`` stands for, or None where it is damaged or has another length."""
    out = np.empty(size, np.uint8)
    return out.tobytes() if _expand(np.frombuffer(packed, np.uint8), out) == size else None
