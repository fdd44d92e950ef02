# SPDX-License-Identifier: Apache-2.0
"""Directions of vectors, the same bytes on every processor.

``np.arctan2`` has one implementation for processors with AVX-512 and another for the rest, which differ in the last bit; yaws of
recordings would too.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from manyeyes._jit import F64x1, njit


@njit(cache=True)
def _fill_directions(y: F64x1, x: F64x1, out: F64x1) -> None:
    for i in range(len(out)):
        out[i] = math.atan2(y[i], x[i])


def direction(y: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return the angles (...) of vectors x, y (...) that broadcast, radians in [-pi, pi]."""
    rise, run = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    out = np.empty(rise.size)
    _fill_directions(np.ascontiguousarray(rise).ravel(), np.ascontiguousarray(run).ravel(), out)
    return out.reshape(rise.shape)
