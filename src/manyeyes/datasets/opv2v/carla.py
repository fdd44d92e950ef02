# SPDX-License-Identifier: Apache-2.0
"""CARLA's left-handed world in degrees, and the right-handed one in radians: the only place where they meet.

The right-handed world has x = x_CARLA, y = -y_CARLA, z = z_CARLA, which are OpenDRIVE's own axes. A rotation about z or
y turns the other way round in the mirror; one about x does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from manyeyes.datatypes import Transform


def transform_from_carla(pose: Sequence[float]) -> Transform:
    """Return world_from_body, float64, of a CARLA pose [x, y, z, roll, yaw, pitch] in metres and degrees."""
    x, y, z, roll, yaw, pitch = (float(v) for v in pose)
    degree = math.pi / 180
    return Transform.from_angles((x, -y, z), (roll * degree, -pitch * degree, -yaw * degree))


def carla_from_transform(world_from_body: Transform) -> tuple[float, ...]:
    """Return the CARLA pose [x, y, z, roll, yaw, pitch] of one rigid motion; the inverse of :func:`transform_from_carla`."""
    x, y, z = world_from_body.translation.double().tolist()
    r = world_from_body.rotation.double().tolist()
    pitch = math.atan2(r[2][0], math.hypot(r[0][0], r[1][0]))
    roll, yaw = math.atan2(r[2][1], r[2][2]), math.atan2(r[1][0], r[0][0])
    return (x, -y, z, math.degrees(roll), -math.degrees(yaw), math.degrees(pitch))


def mirror_points(xyz: np.ndarray) -> np.ndarray:
    """Return points (N, 3) with y to the right as points with y to the left, or back; a copy."""
    mirrored = np.array(xyz, np.float32)
    mirrored[:, 1] *= -1
    return mirrored
