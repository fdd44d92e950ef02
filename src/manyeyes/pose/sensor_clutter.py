# SPDX-License-Identifier: Apache-2.0
"""False boxes that are fixed to the sensors: they coincide where the frames of two agents coincide, whatever the true pose.

Such boxes agree at the identity pose, and hundreds of them outweigh a prior and all true objects. They are found by the number of
pairs that coincide in both agents' frames, against the numbers at shifted frames, which count chance and traffic. Common objects of
vehicles beside each other can coincide too, far behind both, where a small turn cancels the shift. They are kept: they agree far
better at another pose than at the identity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.ops.rigid import fit_se2
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.types import PosePrior, wrap_angle

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class IdentityFilter:
    """When landmarks that coincide in both agents' own frames are fixed to the sensors: the identity is then no pose of the agents.

    max_distance_m, max_turn_rad, max_size_difference_m: of two landmarks that coincide. min_pairs: pairs that are needed at least.
    min_removed: from so many pairs on, their landmarks are removed; fewer, which may be common objects, do not hide the true pose.
    excess_sigmas: by which they exceed the mean number at shifted frames. max_variance_ratio: variance that the best other pose of
    such pairs explains, over the one it leaves, up to which they are fixed to the sensors (an F ratio of three and 2 n - 3 degrees
    of freedom). pose_m, pose_rad: a pose with a smaller translation and turn is the identity. prior_sigmas: standard deviations
    within which a prior counts as near the identity.
    """

    max_distance_m: float = 1.5
    max_turn_rad: float = 0.15
    max_size_difference_m: float = 1.0
    min_pairs: int = 5
    min_removed: int = 8
    excess_sigmas: float = 4.0
    max_variance_ratio: float = 7.0
    pose_m: float = 1.5
    pose_rad: float = math.radians(5.0)
    prior_sigmas: float = 2.0

    def __post_init__(self) -> None:
        positive = self.max_distance_m, self.max_turn_rad, self.pose_m, self.pose_rad, self.max_variance_ratio
        if min(positive) <= 0 or min(self.min_pairs, self.min_removed) < 1:
            raise ConfigError(
                "IdentityFilter needs distances, angles and max_variance_ratio above 0, min_pairs >= 1 and min_removed >= 1."
            )

    def is_identity(self, poses: Floats) -> Bools:
        """Return (N,) bool: which poses (N, 3) are the identity."""
        turn = np.abs(np.remainder(poses[:, 2] + np.pi, 2 * np.pi) - np.pi)
        return (np.hypot(poses[:, 0], poses[:, 1]) < self.pose_m) & (turn < self.pose_rad)

    def is_plausible(self, prior: PosePrior | None) -> bool:
        """Return whether a prior states that the agents' frames may coincide."""
        if prior is None:
            return False
        x, y, yaw = prior.pose
        sigma_m, sigma_rad = (
            math.sqrt(max(*np.diag(prior.covariance)[:2], 0.0)),
            math.sqrt(max(prior.covariance[2, 2], 0.0)),
        )
        is_near = math.hypot(x, y) < self.pose_m + self.prior_sigmas * sigma_m
        return is_near and abs(wrap_angle(yaw)) < self.pose_rad + self.prior_sigmas * sigma_rad


_RADII_M, _NUM_ANGLES = (3.0, 4.0, 5.0, 6.0, 7.0), 5
_SHIFTS = np.array(
    [
        sign * radius * np.array([math.cos(math.pi * n / _NUM_ANGLES), math.sin(math.pi * n / _NUM_ANGLES)])
        for n, radius in enumerate(_RADII_M)
        for sign in (1.0, -1.0)
    ]
)
"""(10, 2) shifts of 3 to 7 m, each with its opposite, so that exchanging the agents changes nothing."""


def find_sensor_fixed(a: Landmarks, b: Landmarks, settings: IdentityFilter) -> tuple[Bools, Bools] | None:
    """Return which landmarks (N,) of a and (M,) of b are removed; None where none seem fixed to the sensors."""
    dx, dy = (a.xy[:, axis, None] - b.xy[None, :, axis] for axis in (0, 1))
    reach = max(_RADII_M) + settings.max_distance_m
    rows, columns = np.nonzero(dx * dx + dy * dy < reach * reach)
    turn = np.abs(np.remainder(a.yaw[rows] - b.yaw[columns] + np.pi / 2, np.pi) - np.pi / 2)
    size = np.abs(a.size[rows] - b.size[columns]).max(1)
    alike = (
        (turn < settings.max_turn_rad)
        & (size < settings.max_size_difference_m)
        & (a.instant[rows] == b.instant[columns])
    )
    rows, columns = rows[alike], columns[alike]
    offset = np.stack((dx[rows, columns], dy[rows, columns]), 1)
    limit = settings.max_distance_m**2
    coincide = np.square(offset).sum(1) < limit
    if coincide.sum() < settings.min_pairs:
        return None
    chance = float(np.mean([(np.square(offset - shift).sum(1) < limit).sum() for shift in _SHIFTS]))
    if coincide.sum() < chance + settings.excess_sigmas * math.sqrt(chance + 1.0):
        return None
    if _agree_elsewhere(a.xy[rows[coincide]], b.xy[columns[coincide]], settings):
        return None
    fixed_a, fixed_b = np.zeros(len(a), bool), np.zeros(len(b), bool)
    if coincide.sum() >= settings.min_removed:
        fixed_a[rows[coincide]] = fixed_b[columns[coincide]] = True
    return fixed_a, fixed_b


def _agree_elsewhere(a: Floats, b: Floats, settings: IdentityFilter) -> bool:
    """Return whether points (N, 2) that coincide agree far better at another pose than the identity."""
    pose = fit_se2(torch.from_numpy(b), torch.from_numpy(a)).numpy()
    if settings.is_identity(pose[None])[0]:
        return False
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    residual = float(np.square(a - b @ np.array([[cos, sin], [-sin, cos]]) - pose[:2]).sum())
    explained, dof = float(np.square(a - b).sum()) - residual, 2 * len(a) - 3
    return explained / 3 > settings.max_variance_ratio * residual / dof
