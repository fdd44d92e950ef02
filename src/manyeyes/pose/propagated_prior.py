# SPDX-License-Identifier: Apache-2.0
"""A sender's last corrected pose, moved on by its own motion, as a second prior beside the stated one."""

from __future__ import annotations

import numpy as np

from manyeyes.pose.corrector import CHI2_3DOF_P001, mahalanobis_squared
from manyeyes.pose.types import PoseEstimate, PosePrior


def propagate_prior(previous: PosePrior, motion: PoseEstimate) -> PosePrior | None:
    """Return the prior of the sender now: ``previous`` of its pose then, ``motion`` of its frame now in its frame then; None
    where the motion is not measured. Their errors are independent.
    """
    if not motion.status.has_estimate or motion.ego_from_other is None:
        return None
    rotation = previous.ego_from_other.rotation[:2, :2].double().numpy()
    x, y = rotation @ motion.ego_from_other.translation[:2].double().numpy()
    lever = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    turn = np.eye(3)
    turn[:2, :2] = rotation
    covariance = lever @ previous.covariance @ lever.T + turn @ motion.covariance @ turn.T
    return PosePrior(previous.ego_from_other @ motion.ego_from_other, (covariance + covariance.T) / 2)


def priors_agree(one: PosePrior, other: PosePrior) -> bool:
    """Whether two independent priors of one pose agree at p = 0.001."""
    return mahalanobis_squared(one.pose, one.covariance, other) <= CHI2_3DOF_P001


def contradicts_both(estimate: PoseEstimate, stated: PosePrior | None, propagated: PosePrior) -> bool:
    """Whether a measured pose contradicts the stated and the propagated prior, which agree with each other."""
    if estimate.measured is None or estimate.measured_covariance is None or stated is None:
        return False
    measured, spread = estimate.measured, estimate.measured_covariance
    return priors_agree(stated, propagated) and all(
        mahalanobis_squared(measured, spread, prior) > CHI2_3DOF_P001 for prior in (stated, propagated)
    )
