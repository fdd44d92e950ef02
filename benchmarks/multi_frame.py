# SPDX-License-Identifier: Apache-2.0
"""Multi-frame accumulation: earlier landmarks transformed into the current frame by the agent's own motion.

An object may have moved since, so only landmarks of one instant are matched; the relative pose is common to all instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose.landmarks import Landmarks

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TimedLandmarks:
    """One agent's landmarks of one instant, in its frame of that instant. instant: how many frames ago, by a clock that both
    agents share. now_from_then: (3,) its own motion since; sigma_xy_m, sigma_yaw_rad: standard deviations of that motion.
    """

    landmarks: Landmarks
    instant: int
    now_from_then: Floats
    sigma_xy_m: float = 0.0
    sigma_yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.now_from_then.shape != (3,) or not np.isfinite(self.now_from_then).all() or self.instant < 0:
            raise ConfigError(
                "TimedLandmarks needs now_from_then as a finite x, y, yaw (3,) and an instant of at least 0; "
                f"got {self.now_from_then.shape} and {self.instant}."
            )


def accumulate(timed_landmarks: Sequence[TimedLandmarks]) -> Landmarks:
    """Concatenate all landmarks in the agent's current frame, each with its instant."""
    return Landmarks.cat([_transform_to_now(s) for s in timed_landmarks])


def _transform_to_now(timed: TimedLandmarks) -> Landmarks:
    here = timed.landmarks
    range_m = np.hypot(*here.xy.T)
    return replace(
        here.transform(timed.now_from_then),
        sigma_xy=np.sqrt(here.sigma_xy**2 + timed.sigma_xy_m**2 + (range_m * timed.sigma_yaw_rad) ** 2),
        sigma_yaw=np.hypot(here.sigma_yaw, timed.sigma_yaw_rad),
        instant=np.full(len(here), timed.instant, np.int64),
    )
