# SPDX-License-Identifier: Apache-2.0
"""Propagated priors: the covariance against samples, and when a measured pose contradicts two priors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes import Transform
from manyeyes.pose.propagated_prior import contradicts_both, priors_agree, propagate_prior
from manyeyes.pose.types import PoseEstimate, PosePrior, PoseStatus, no_estimate


def measure(pose: tuple[float, float, float], sigma_m: float = 0.1, sigma_rad: float = 0.01) -> PoseEstimate:
    covariance = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
    at = Transform.from_xyz_yaw(pose[0], pose[1], 0.0, pose[2])
    return PoseEstimate(
        at, covariance, PoseStatus.OK, 5, 0, 9.0, np.zeros((5, 2), np.int64), np.array(pose), covariance, 1.0
    )


def test_the_covariance_is_that_of_samples() -> None:
    rng = np.random.default_rng(0)
    previous = PosePrior.from_pose([20.0, -5.0, 0.8], np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0], [0, 0, 0.02**2]]))
    motion = measure((3.0, 1.0, 0.2))
    found = propagate_prior(previous, motion)
    assert found is not None
    x, y, yaw = (rng.multivariate_normal(previous.pose, previous.covariance, 40_000)).T
    u, v, turn = (rng.multivariate_normal([3.0, 1.0, 0.2], motion.covariance, 40_000)).T
    samples = np.stack((x + np.cos(yaw) * u - np.sin(yaw) * v, y + np.sin(yaw) * u + np.cos(yaw) * v, yaw + turn), 1)
    np.testing.assert_allclose(found.pose, samples.mean(0), atol=5e-3)
    np.testing.assert_allclose(found.covariance, np.cov(samples.T), rtol=0.05, atol=2e-4)
    assert propagate_prior(previous, no_estimate(previous)) is None


@pytest.mark.parametrize(
    ("measured", "stated", "propagated", "wanted"),
    [
        ((20.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), True),  # two agree, the third is elsewhere
        ((20.0, 0.0, 0.0), (0.0, 0.0, 0.0), (20.1, 0.0, 0.0), False),  # the stated one is alone
        ((20.0, 0.0, 0.0), (20.1, 0.0, 0.0), (0.0, 0.0, 0.0), False),  # the propagated one is alone
        ((20.0, 0.0, 0.0), (0.0, 0.0, 0.0), (9.0, 0.0, 0.0), False),  # no two agree
        ((0.1, 0.0, math.pi), (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), True),  # turned by half a circle
    ],
)
def test_a_measured_pose_is_rejected_only_where_the_two_others_agree(
    measured: tuple[float, ...], stated: tuple[float, ...], propagated: tuple[float, ...], wanted: bool
) -> None:
    first, second = (PosePrior.of(list(pose), 0.2, 0.02) for pose in (stated, propagated))
    assert contradicts_both(measure((measured[0], measured[1], measured[2])), first, second) is wanted
    assert priors_agree(first, second) is (abs(stated[0] - propagated[0]) < 1)


def test_nothing_is_contradicted_without_a_measured_pose_or_a_stated_prior() -> None:
    prior = PosePrior.of([0.0, 0.0, 0.0], 0.2, 0.02)
    assert not contradicts_both(no_estimate(prior), prior, prior)
    assert not contradicts_both(measure((20.0, 0.0, 0.0)), None, prior)
    assert not contradicts_both(replace(measure((20.0, 0.0, 0.0)), measured_covariance=None), prior, prior)
