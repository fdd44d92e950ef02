# SPDX-License-Identifier: Apache-2.0
"""Prior, estimate and status of a relative pose, and the interface of correctors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import AgentFrame, ConfigError, Message, ShapeError, Transform
from manyeyes.datatypes.numbers import Numbers, as_tensor
from manyeyes.pose.landmarks import Landmarks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class PoseStatus(Enum):
    """Result of comparing the pose measured from common objects with the prior.

    OK: measurement and prior agree. CORRECTED: the pose is measured; there is no prior, or the chi^2 test is inconclusive.
    CONFLICT: the pose is measured and the prior contradicts it. AMBIGUOUS: more than one pose fits, or the one that fits
    contradicts both the prior and the sender's propagated pose. NO_MATCH: none fits.
    """

    OK = "ok"
    CORRECTED = "corrected"
    CONFLICT = "conflict"
    AMBIGUOUS = "ambiguous"
    NO_MATCH = "no match"

    @property
    def has_estimate(self) -> bool:
        """Whether the pose was measured from objects."""
        return self in (PoseStatus.OK, PoseStatus.CORRECTED, PoseStatus.CONFLICT)


@dataclass(frozen=True)
class PosePrior:
    """A prior on ego_from_other; covariance: (3, 3) of x, y (m) and yaw (rad) in the ego's axes."""

    ego_from_other: Transform
    covariance: Floats

    def __post_init__(self) -> None:
        if self.covariance.shape != (3, 3) or self.ego_from_other.translation.shape != (3,):
            raise ShapeError(
                "PosePrior needs one transform and a covariance (3, 3); "
                f"got {tuple(self.ego_from_other.translation.shape)} and {self.covariance.shape}."
            )
        finite = np.isfinite(self.covariance).all() and bool(self.ego_from_other.matrix().isfinite().all())
        if not finite or np.linalg.eigvalsh((self.covariance + self.covariance.T) / 2).min() < -1e-9:
            raise ConfigError(
                "PosePrior needs a finite transform and a finite covariance without a negative variance; "
                "give no prior (None) where nothing is known."
            )

    @classmethod
    def of(cls, ego_from_other: Transform | Numbers, sigma_xy_m: float, sigma_yaw_rad: float) -> PosePrior:
        """Return a prior whose errors in x, y and yaw are independent; of a transform, or of x, y (m) and yaw (rad).

        Raises:
            ShapeError: the pose is neither. ConfigError: a value is not finite.
        """
        return cls(
            _as_transform(ego_from_other, "PosePrior.of"), np.diag([sigma_xy_m**2, sigma_xy_m**2, sigma_yaw_rad**2])
        )

    @classmethod
    def from_pose(cls, ego_from_other: Transform | Numbers, covariance: Numbers) -> PosePrior:
        """Return a prior of a transform, or of x, y (m) and yaw (rad), with a covariance (3, 3) of these in the ego's axes.

        Raises:
            ShapeError: the pose is neither, or the covariance has another shape. ConfigError: a value is not finite.
        """
        spread = as_tensor(covariance, "PosePrior.from_pose", torch.float64).numpy()
        return cls(_as_transform(ego_from_other, "PosePrior.from_pose"), spread)

    @classmethod
    def between(cls, ego: AgentFrame | Message, other: AgentFrame | Message) -> PosePrior:
        """Return the prior from two agents' reported poses: errors of both, and the ego's yaw error at the other's distance."""
        ego_from_other = ego.world_from_agent.inverse() @ other.world_from_agent
        x, y, _ = project_to_se2(ego_from_other)
        c, s = float(ego.world_from_agent.yaw.cos()), float(ego.world_from_agent.yaw.sin())
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]]) @ turn
        parts = [(lever, ego.pose_covariance), (turn, other.pose_covariance)]
        return cls(ego_from_other, sum((by @ c.double().numpy() @ by.T for by, c in parts), np.zeros((3, 3))))

    @property
    def pose(self) -> Floats:
        """(3,) x, y (m), yaw (rad)."""
        return project_to_se2(self.ego_from_other)


@dataclass(frozen=True)
class PoseEstimate:
    """A corrector's estimate of ego_from_other.

    ego_from_other: the pose to use, None where nothing is known; x, y and yaw are corrected, height and tilt are the prior's.
    covariance: (3, 3) of x, y (m), yaw (rad) in the ego's axes. inliers: number of inlier pairs; runner_up: inlier pairs of the
    best *distinct* other candidate; margin: log-likelihood difference to that one. pairs: (inliers, 2) rows of ego's and other's
    landmarks. measured, measured_covariance: (3,), (3, 3) the pose from objects alone, where it is unique. mahalanobis_squared:
    squared Mahalanobis distance of that from the prior (3 degrees of freedom), NaN without both.
    """

    ego_from_other: Transform | None
    covariance: Floats
    status: PoseStatus
    inliers: int
    runner_up: int
    margin: float
    pairs: Ints
    measured: Floats | None
    measured_covariance: Floats | None
    mahalanobis_squared: float

    @property
    def pose(self) -> Floats | None:
        """(3,) x, y (m), yaw (rad) of ego_from_other."""
        return None if self.ego_from_other is None else project_to_se2(self.ego_from_other)


class PoseCorrector(Protocol):
    """The common interface of the default corrector and the baselines."""

    def __call__(self, ego: Landmarks, other: Landmarks, prior: PosePrior | None) -> PoseEstimate:
        """Estimate ego_from_other from both agents' landmarks and an optional prior."""
        ...


def _as_transform(pose: Transform | Numbers, name: str) -> Transform:
    """Return a transform, or the planar one of x, y (m) and yaw (rad)."""
    if isinstance(pose, Transform):
        return pose
    numbers = as_tensor(pose, name, torch.float64)
    if numbers.shape != (3,):
        raise ShapeError(f"{name} needs a transform, or x, y and yaw (3,); got {tuple(numbers.shape)}.")
    return Transform.from_xyz_yaw(float(numbers[0]), float(numbers[1]), 0.0, float(numbers[2]))


def project_to_se2(transform: Transform) -> Floats:
    """Project one transform to the plane: (3,) x, y (m), yaw (rad)."""
    x, y = transform.translation[:2].tolist()
    return np.array([x, y, float(transform.yaw)])


def lift_to_se3(pose: Floats, prior: PosePrior | None) -> Transform:
    """Lift a planar pose (3,) to a transform with the height and tilt of the prior."""
    flat = Transform.from_xyz_yaw(float(pose[0]), float(pose[1]), 0.0, float(pose[2]))
    if prior is None:
        return flat
    reported = prior.ego_from_other
    turn = Transform.from_xyz_yaw(0.0, 0.0, 0.0, float(pose[2]) - float(reported.yaw)).rotation
    lifted = torch.stack((flat.translation[0], flat.translation[1], reported.translation[2].double()))
    return Transform(turn @ reported.rotation.double(), lifted)


def no_estimate(prior: PosePrior | None, status: PoseStatus = PoseStatus.NO_MATCH) -> PoseEstimate:
    """Return the estimate where no pose is measured: the prior unchanged, or nothing."""
    return PoseEstimate(
        None if prior is None else prior.ego_from_other,
        np.full((3, 3), np.inf) if prior is None else prior.covariance,
        status,
        0,
        0,
        0.0,
        np.zeros((0, 2), np.int64),
        None,
        None,
        float("nan"),
    )


def wrap_angle(angle: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def pose_difference(a: Floats, b: Floats) -> Floats:
    """a - b of two poses (3,), the yaw in [-pi, pi)."""
    return np.array([a[0] - b[0], a[1] - b[1], wrap_angle(a[2] - b[2])])
