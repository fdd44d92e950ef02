# SPDX-License-Identifier: Apache-2.0
"""Keys of occupied cells in compiled loops, on the CPU: a dozen tensor operations each would be, for a few hundred cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from manyeyes._jit import F32x2, I64x1, njit


class CellLattice(NamedTuple):
    """A ``BevGrid`` for the loops: cells of edge stride pillars, a pillar in metres, from the corner x_min, y_min."""

    rows: int
    columns: int
    stride: int
    pillar: float
    x_min: float
    y_min: float


@njit(cache=True, nogil=True)
def are_valid_keys(key: I64x1, size: int) -> bool:  # pragma: no cover
    """Return whether keys (N,) ascend strictly and lie in [0, size)."""
    last = np.int64(-1)
    for k in key:
        if k <= last:
            return False
        last = k
    return bool(last < size)


@njit(cache=True, nogil=True)
def compute_centers(key: I64x1, lattice: CellLattice) -> F32x2:  # pragma: no cover
    """Return (N, 2) float32: ``BevGrid.centers`` of ascending keys (N,)."""
    rows, columns, stride, pillar, x_min, y_min = lattice
    xy = np.empty((key.shape[0], 2), np.float32)
    start, end, y = 0, 0, 0.0
    for i in range(key.shape[0]):
        if key[i] >= end:
            line = key[i] // columns
            start, end = line * columns, (line + 1) * columns
            y = y_min + (line % rows * stride + 0.5) * pillar
        xy[i, 0], xy[i, 1] = x_min + ((key[i] - start) * stride + 0.5) * pillar, y
    return xy
