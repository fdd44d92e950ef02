# SPDX-License-Identifier: Apache-2.0
"""Weights of observations in the positions of stations, where redundant observations of one agent share their weight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, I64x1, njit
from manyeyes.maps.fusion.observation_arrays import ObservationArrays
from manyeyes.maps.fusion.point_grid import build_grid, find_cell_range

Floats = NDArray[np.float64]


def compute_observation_weights(
    arrays: ObservationArrays, initial_pose: Floats, scale: Floats, agent_weight: Floats, radius_m: float = 30.0
) -> Floats:
    """Compute the weight (O,) of each observation's lines in the positions of stations.

    Surveyed poles have weight 50. Other weights fall with the residual scale (O,) in metres, with the agent weight (O,), and
    with the number of observations of the same agent within ``radius_m``.
    """
    grid = build_grid(initial_pose[:, 0], initial_pose[:, 1], np.zeros(len(initial_pose), np.int64), radius_m)
    num_redundant = _count_same_agent(
        initial_pose, np.asarray(arrays.agent), grid.keys, grid.offsets, grid.order, radius_m
    )
    scale_weight = 1.0 / (1.0 + (scale / 0.2) ** 4)
    return np.where(arrays.trusted, 50.0, 2.0 * scale_weight * agent_weight / num_redundant)


@njit(cache=True, nogil=True)
def _count_same_agent(
    pose: F64x2, agent: I64x1, keys: I64x1, start: I64x1, order: I64x1, radius: float
) -> F64x1:  # pragma: no cover - compiled
    """Count observations (O,) of the same agent within a radius, each weighted by 1 - (distance / radius)²; itself counts 1."""
    counts = np.zeros(len(pose))
    for o in range(len(pose)):
        ix, iy = int(np.floor(pose[o, 0] / radius)), int(np.floor(pose[o, 1] / radius))
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for q in range(low, high):
                other = order[q]
                if agent[other] == agent[o]:
                    d = ((pose[other, 0] - pose[o, 0]) ** 2 + (pose[other, 1] - pose[o, 1]) ** 2) / radius**2
                    counts[o] += max(0.0, 1.0 - d)
    return counts
