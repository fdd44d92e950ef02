# SPDX-License-Identifier: Apache-2.0
"""Fractal noise in the plane: how textures of the simulator's pictures vary."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

_SIDE, _WAVES = 1024, 16


@lru_cache(maxsize=1)
def _tile() -> NDArray[np.float32]:
    """Return (1024, 1024) periodic noise of mean 0 and variance 1 whose amplitude falls with frequency: the same in every
    process.
    """
    random = np.random.Generator(np.random.Philox(key=7))
    row_frequency, column_frequency = np.fft.fftfreq(_SIDE)[:, None] * _SIDE, np.fft.rfftfreq(_SIDE)[None] * _SIDE
    frequency = np.hypot(row_frequency, column_frequency)
    frequency[0, 0] = np.inf
    tile = np.fft.irfft2(np.fft.rfft2(random.standard_normal((_SIDE, _SIDE))) / np.maximum(frequency, _WAVES) ** 1.5)
    return ((tile - tile.mean()) / tile.std()).astype(np.float32)


def fractal_noise(xy: NDArray[np.floating], scale: float, seed: int) -> NDArray[np.floating]:
    """Return (N,) about normal values at points (N, 2), bilinear: waves as long as ``scale``, and ever weaker ones down to
    1/32 of it.

    It repeats after 16 scales; seed shifts it.
    """
    tile = _tile()
    shift = ((seed * 2654435761) % 2**32 / 2**32 * _SIDE, (seed * 40503 % 65536) / 65536 * _SIDE)
    u = np.asarray(xy[:, 0] * (_SIDE / _WAVES / scale) + shift[0], np.float64)
    v = np.asarray(xy[:, 1] * (_SIDE / _WAVES / scale) + shift[1], np.float64)
    column, row = np.floor(u), np.floor(v)
    a, b = (u - column).astype(np.float32), (v - row).astype(np.float32)
    j, i = column.astype(np.int64) & (_SIDE - 1), row.astype(np.int64) & (_SIDE - 1)
    k, m = (j + 1) & (_SIDE - 1), (i + 1) & (_SIDE - 1)
    low = tile[i, j] + a * (tile[i, k] - tile[i, j])
    return low + b * (tile[m, j] + a * (tile[m, k] - tile[m, j]) - low)
