# SPDX-License-Identifier: Apache-2.0
"""Sight of an agent: how far the ground around its LiDAR is free, by direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.map_element import freeze

NUM_SECTORS = 180
STEP_M = 0.5
MIN_FREE_M = 5.0
"""A sight states nothing nearer to the LiDAR: rays to the ground there lie below the field of view of many sensors."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Free ranges of an agent about the origin of its frame, where rays at the height of vehicles passed.

    steps: (NUM_SECTORS,) uint8, in STEP_M: sector k has the azimuths from 2 k to 2 k + 2 degrees, counterclockwise from x. From
    MIN_FREE_M to its free range a sector holds no vehicle at the time of the sweep. Nothing is stated beyond; 0 states nothing.
    """

    steps: NDArray[np.uint8]

    def __post_init__(self) -> None:
        if np.shape(self.steps) != (NUM_SECTORS,):
            raise ShapeError(f"Sight.steps needs shape ({NUM_SECTORS},); got {np.shape(self.steps)}.")
        object.__setattr__(self, "steps", freeze(self.steps, np.uint8))

    @property
    def free_m(self) -> NDArray[np.float64]:
        """Free range (NUM_SECTORS,) of each sector, metres."""
        return self.steps.astype(np.float64) * STEP_M
