# SPDX-License-Identifier: Apache-2.0
"""Bounds on the numbers of an observation.

A coordinate that is finite but far, or a line of a million points, would otherwise cost memory and time without bound in the
steps of a fusion. Each bound lies well above what sensors, map models and the wire format produce;
docs/reference/map-observations.md lists them with their reasons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ObservationLimits:
    """Bound what one observation may state; a value outside makes the observation unusable."""

    # Pseudonym, pass and model: characters of each.
    max_text_length: int = 256
    # |x| and |y| of the pose; 200 km from the origin the projection stretches lengths by 0.05 %, 5 cm in 100 m.
    max_position_m: float = 200_000.0
    # |yaw|; a heading that was unwrapped over a drive is some turns, not thousands.
    max_yaw_rad: float = 100.0
    # Standard deviation of x and of y; 1 km does not tell the street.
    max_position_std_m: float = 1000.0
    # Standard deviation of the yaw; one that is spread evenly over the circle has 1.81 rad.
    max_yaw_std_rad: float = math.pi
    # Standard deviation of x, y (m) and yaw (rad); below it the inverse of the covariance is no longer exact.
    min_pose_std: float = 1e-6
    # |x| and |y| of each point in the agent's frame; the wire format ends at 327.66 m.
    max_reach_m: float = 500.0
    # Points of a view, of an occluder or of a crossing; the test for edges that cross is quadratic in them.
    max_ring_points: int = 1000
    # Length of a crossing's border; the whole tile of a semi-global map has 360 m.
    max_crossing_perimeter_m: float = 500.0
    # Rings that hide parts of the view.
    max_occluders: int = 256
    # Lines and crossings of one observation.
    max_elements: int = 1000
    # Points of all elements of one observation.
    max_points: int = 50_000
    # Length of all elements of one observation; a fusion samples each about every metre.
    max_length_m: float = 20_000.0
    # Points of an element: these whatever its length, ...
    max_points_at_once: int = 100
    # ... and so many more for each metre of it.
    max_points_per_m: float = 50.0
    # Standard deviation of a point across its line.
    max_sigma_m: float = 1000.0


LIMITS = ObservationLimits()
"""What every observation is checked against."""
