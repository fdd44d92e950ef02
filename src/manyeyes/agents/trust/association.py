# SPDX-License-Identifier: Apache-2.0
"""One-to-one association of positions within a gate, nearest pairs first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.agents.trust._association_kernels import find_partners, nearest_rows

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


def associate(one: Floats, other: Floats, gate_m: Floats | float) -> Rows:
    """Return (N,) int64: for each position (N, 2) the row of its partner among (M, 2), -1 without one.

    gate_m: a number or (N,), metres; pairs are nearer.
    """
    gate = np.empty(len(one))
    gate[:] = gate_m
    return find_partners(np.ascontiguousarray(one), np.ascontiguousarray(other), gate)


def find_nearest(one: Floats, other: Floats, radius_m: float) -> Rows:
    """Return (N,) int64: for each position (N, 2) the row of the nearest of (M, 2), -1 where none is within the radius."""
    return nearest_rows(np.ascontiguousarray(one), np.ascontiguousarray(other), float(radius_m))


def associate_reference(one: Floats, other: Floats, gate_m: Floats | float) -> Rows:
    """Do the same by sorting all pairs."""
    gate = np.broadcast_to(np.asarray(gate_m, np.float64), (len(one),))
    distance = np.hypot(one[:, None, 0] - other[None, :, 0], one[:, None, 1] - other[None, :, 1])
    partner: dict[int, int] = {}
    for row, column in sorted(np.ndindex(*distance.shape), key=lambda pair: (distance[pair], pair)):
        if distance[row, column] < gate[row] and row not in partner and column not in partner.values():
            partner[row] = column
    return np.array([partner.get(row, -1) for row in range(len(one))], np.int64)
