# SPDX-License-Identifier: Apache-2.0
"""How loops are compiled: numba's njit, whose results are kept on disk by one process at a time.

numba numbers the cache files of a function's variants: two processes that compile two variants at the same time use one file name
for both, and later processes load the wrong variant without an error. Workers that start together on a fresh installation are such
processes. Every compiled loop of the package takes njit from here.
"""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
from filelock import FileLock
from numba import njit
from numba.core import caching

__all__ = [
    "Boolx1",
    "Boolx2",
    "F32x1",
    "F32x2",
    "F32x3",
    "F32x4",
    "F32x5",
    "F64x1",
    "F64x2",
    "F64x3",
    "I8x2",
    "I32x1",
    "I32x2",
    "I64x1",
    "I64x2",
    "I64x3",
    "U8x1",
    "U8x2",
    "Uintpx1",
    "njit",
]


class _LockedIndexFile(caching.IndexDataCacheFile):
    """numba's index of a function's variants and of their files, locked while it is read or written."""

    def load(self, key: Any) -> Any:
        with self._lock():
            return super().load(key)

    def save(self, key: Any, data: Any) -> None:
        with self._lock():
            super().save(key, data)

    def _load_index(self) -> Any:
        """Return the variants; none where the index is damaged or names classes of other code, so that they are compiled anew."""
        try:
            return super()._load_index()
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError):
            return {}

    def _lock(self) -> FileLock:
        return FileLock(f"{self._index_path}.lock")


caching.IndexDataCacheFile = _LockedIndexFile

Int64 = int | np.int64
"""Integer of a compiled loop."""

# Arrays of compiled loops: element type and number of dimensions.
Boolx1 = np.ndarray[tuple[int], np.dtype[np.bool_]]
Boolx2 = np.ndarray[tuple[int, int], np.dtype[np.bool_]]
F32x1 = np.ndarray[tuple[int], np.dtype[np.float32]]
F32x2 = np.ndarray[tuple[int, int], np.dtype[np.float32]]
F32x3 = np.ndarray[tuple[int, int, int], np.dtype[np.float32]]
F32x4 = np.ndarray[tuple[int, int, int, int], np.dtype[np.float32]]
F32x5 = np.ndarray[tuple[int, int, int, int, int], np.dtype[np.float32]]
F64x1 = np.ndarray[tuple[int], np.dtype[np.float64]]
F64x2 = np.ndarray[tuple[int, int], np.dtype[np.float64]]
F64x3 = np.ndarray[tuple[int, int, int], np.dtype[np.float64]]
I8x2 = np.ndarray[tuple[int, int], np.dtype[np.int8]]
I32x1 = np.ndarray[tuple[int], np.dtype[np.int32]]
I32x2 = np.ndarray[tuple[int, int], np.dtype[np.int32]]
I64x1 = np.ndarray[tuple[int], np.dtype[np.int64]]
I64x2 = np.ndarray[tuple[int, int], np.dtype[np.int64]]
I64x3 = np.ndarray[tuple[int, int, int], np.dtype[np.int64]]
U8x1 = np.ndarray[tuple[int], np.dtype[np.uint8]]
U8x2 = np.ndarray[tuple[int, int], np.dtype[np.uint8]]
Uintpx1 = np.ndarray[tuple[int], np.dtype[np.uintp]]
