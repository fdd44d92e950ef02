# SPDX-License-Identifier: Apache-2.0
"""One-to-one association of positions within a gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


def associate(one: Floats, other: Floats, gate_m: Floats | float) -> Rows:
    """Return (N,) int64: for each position (N, 2) the row of its partner among (M, 2), -1 without one.

    The sum of distances is minimal, where a pair beyond the gate, a number or (N,) metres, costs as much as the gate.
    """
    partner = np.full(len(one), -1, np.int64)
    if not len(one) or not len(other):
        return partner
    distance = np.hypot(one[:, None, 0] - other[None, :, 0], one[:, None, 1] - other[None, :, 1])
    gate = np.broadcast_to(np.asarray(gate_m, np.float64), (len(one),))[:, None]
    rows, columns = linear_sum_assignment(np.minimum(distance, gate))
    is_pair = distance[rows, columns] < gate[rows, 0]
    partner[rows[is_pair]] = columns[is_pair]
    return partner
