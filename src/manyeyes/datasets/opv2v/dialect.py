# SPDX-License-Identifier: Apache-2.0
"""How data sets in OPV2V's layout depart from OPV2V: axes, the frame of boxes, types of objects, and file names.

V2V4Real (two vehicles, 0 and 1): real LiDARs, so axes are right-handed (y to the left); ``lidar_pose`` is a 4x4 matrix; objects are
listed in the agent's own LiDAR frame, and ``ass_id`` links an object of both lists (-1: none). V2X-Real (vehicles 1 and 2, roadside
units -1 and -2): right-handed too, poses of six numbers, objects in the world, clouds as ``.bin``. Both are recorded at 10 Hz.

A pose of six numbers [x, y, z, roll, yaw, pitch] stands for one matrix in all of them, the one in ``carla``; only what its axes
mean differs. Objects that are neither vehicles nor people on or off two wheels, such as cones and hydrants, are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from manyeyes.datasets.opv2v.carla import transform_from_carla
from manyeyes.datatypes import Transform

V2V4REAL_AGENTS = frozenset({"0", "1"})
V2X_REAL_AGENTS = frozenset({"-2", "-1", "1", "2"})
_V2V4REAL_NAME, _V2X_REAL_NAME = "CAV_data", re.compile(r"\d{4}-\d{2}-\d{2}-\d{2}-\d{2}-\d{2}(_.*)?")


class Traits(Protocol):
    """What metadata tell about their data set."""

    @property
    def has_matrix(self) -> bool:
        """Whether lidar_pose is a 4x4 matrix."""
        ...

    @property
    def has_links(self) -> bool:
        """Whether an object has an ``ass_id``."""
        ...

    @property
    def has_named_types(self) -> bool:
        """Whether a type is capitalised."""
        ...


@dataclass(frozen=True)
class Dialect:
    """What differs between data sets in OPV2V's layout.

    is_right_handed: y is to the left, in clouds and in the world. are_boxes_local: objects are listed in the agent's LiDAR frame,
    not in the world. delta_s: seconds between two stems where data_protocol.yaml does not state it.
    """

    name: str
    is_right_handed: bool = False
    are_boxes_local: bool = False
    delta_s: float = 0.05

    def world_from_lidar(self, pose: Sequence[float]) -> Transform:
        """Return the motion, float64, that [x, y, z, roll, yaw, pitch] in metres and degrees stands for, in right-handed axes."""
        if not self.is_right_handed:
            return transform_from_carla(pose)
        x, y, z, roll, yaw, pitch = (float(v) for v in pose)
        degree = math.pi / 180
        return Transform.from_angles((x, y, z), (-roll * degree, -pitch * degree, yaw * degree))


OPV2V = Dialect("OPV2V")
V2V4REAL = Dialect("V2V4Real", is_right_handed=True, are_boxes_local=True, delta_s=0.1)
V2X_REAL = Dialect("V2X-Real", is_right_handed=True, delta_s=0.1)


def pose_of_matrix(matrix: np.ndarray) -> tuple[float, ...]:
    """Return [x, y, z, roll, yaw, pitch], degrees, of the matrix (4, 4) that it stands for, float64."""
    r = matrix[:3, :3]
    pitch = math.atan2(r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    roll, yaw = math.atan2(-r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    return (*matrix[:3, 3].tolist(), math.degrees(roll), math.degrees(yaw), math.degrees(pitch))


def name_dialect(scenario: str, has_binary_clouds: bool) -> Dialect | None:
    """Return the dialect of a scenario by the name of its folder and the type of its clouds; None where they do not tell."""
    if _V2V4REAL_NAME in scenario:
        return V2V4REAL
    return V2X_REAL if has_binary_clouds or _V2X_REAL_NAME.fullmatch(scenario) else None


def choose_dialect(agents: Sequence[str], records: Sequence[Traits]) -> Dialect:
    """Return the dialect of a scenario by the names of its agents and by metadata of an instant.

    A matrix is V2V4Real's, if objects are linked, have capitalised types, or the agents are 0 and 1; else it stands for the six
    numbers of OPV2V. Six numbers with capitalised types, of agents named as in V2X-Real, are V2X-Real's.
    """
    named_types = any(record.has_named_types for record in records)
    if any(record.has_matrix for record in records):
        linked = any(record.has_links for record in records)
        return V2V4REAL if linked or named_types or frozenset(agents) <= V2V4REAL_AGENTS else OPV2V
    return V2X_REAL if named_types and frozenset(agents) <= V2X_REAL_AGENTS else OPV2V
