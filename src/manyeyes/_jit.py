# SPDX-License-Identifier: Apache-2.0
"""How loops are compiled: numba's njit, whose results are kept on disk by one process at a time.

numba names the files of a function's variants by counting: two processes that compile two variants at the same time give both one
name, and from then on whoever asks for one of them runs the other, without an error. Workers that begin together on a fresh
installation do just that. Every compiled loop of the package takes njit from here.
"""

from __future__ import annotations

from typing import Any

from filelock import FileLock
from numba import njit
from numba.core import caching

__all__ = ["njit"]


class _OneAtATime(caching.IndexDataCacheFile):
    """numba's index of a function's variants and of their files, locked while it is read or written."""

    def load(self, key: Any) -> Any:
        with self._lock():
            return super().load(key)

    def save(self, key: Any, data: Any) -> None:
        with self._lock():
            super().save(key, data)

    def _lock(self) -> FileLock:
        return FileLock(f"{self._index_path}.lock")


caching.IndexDataCacheFile = _OneAtATime
