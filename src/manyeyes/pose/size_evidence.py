# SPDX-License-Identifier: Apache-2.0
"""Evidence of sizes: whether two landmarks are one object, from their lengths and widths.

Most vehicles are alike, so equal sizes are little evidence, but two equal trucks are much. The log-likelihood ratio compares the
difference of two sizes with those of all pairs of landmarks at hand, so that its scale follows from the scene. A heavy tail bounds
the evidence against a pair.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes.pose.landmarks import Landmarks

Floats = NDArray[np.float64]

SIGMA_SIZE_M = (0.3, 0.12)
"""Standard deviations of differences of length and width of one object, observed by two agents."""
_TAIL_FRACTION, _TAIL_SCALE = 0.1, 3.0


def compute_size_evidence(a: Landmarks, b: Landmarks) -> Floats:
    """Return (N, M) log-likelihood ratios of sizes: one object, against two of the landmarks of a and b; symmetric in both."""
    total = np.zeros((len(a), len(b)))
    for axis, sigma in enumerate(SIGMA_SIZE_M):
        squared = np.square((a.size[:, axis, None] - b.size[None, :, axis]) / sigma)
        density = (1 - _TAIL_FRACTION) * np.exp(-squared / 2)
        density += _TAIL_FRACTION / _TAIL_SCALE * np.exp(-squared / (2 * _TAIL_SCALE**2)) + 1e-12
        chance_a, chance_b = np.log(density.mean(1)), np.log(density.mean(0))
        total += np.log(density) - (chance_a[:, None] + chance_b[None]) / 2
    return total
