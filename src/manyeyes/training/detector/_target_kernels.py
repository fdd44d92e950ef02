# SPDX-License-Identifier: Apache-2.0
"""Which box contains a cell, in one compiled loop: on the CPU, tensors of all cells times all boxes cost ten times as much."""

from __future__ import annotations

import numpy as np

from manyeyes._jit import F32x2, F32x3, I64x1, I64x2, njit


@njit(cache=True, nogil=True)
def find_containing_boxes(
    xy: F32x2, batch: I64x1, places: F32x3, row: I64x2, margin_m: float
) -> I64x1:  # pragma: no cover
    """Return for each place xy (N, 2) the row of the box of its grid that contains it and whose centre is nearest, -1 for none.

    batch: (N,), the grid of each place. places: (B, K, 6) and row: (B, K), of a ``BoxBatch``. margin_m: of all boxes.
    """
    found, margin = np.full(len(xy), -1), np.float32(margin_m)
    for i in range(len(xy)):
        b, nearest = batch[i], np.float32(np.inf)
        for k in range(row.shape[1]):
            if row[b, k] < 0:
                continue
            box = places[b, k]
            dx, dy = xy[i, 0] - box[0], xy[i, 1] - box[1]
            distance = dx * dx + dy * dy
            if distance >= nearest or abs(dx * box[2] + dy * box[3]) > box[4] + margin:
                continue
            if abs(dy * box[2] - dx * box[3]) <= box[5] + margin:
                nearest, found[i] = distance, row[b, k]
    return found
