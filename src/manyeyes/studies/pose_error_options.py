# SPDX-License-Identifier: Apache-2.0
"""Options of pose errors: how they go on in time, what agents claim of them, and how odometry drifts; without heavy imports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from manyeyes._bounds import DurationS

if TYPE_CHECKING:
    from manyeyes.datasets.odometry_drift import OdometryDrift
    from manyeyes.datasets.perturbation import PoseNoise


@dataclass(frozen=True)
class PoseErrorOptions:
    """Of what kind pose errors are; their level is another option, or that of a study's rows."""

    claimed_covariance: Literal["none", "half", "true", "double"] = "none"
    """Standard deviation of the injected pose errors that agents state, of the true one; the same for all methods."""
    noise_in_time: Literal["autoregressive", "constant", "independent"] = "autoregressive"
    """How the pose error of an agent goes on: first-order autoregressive, one error a scenario, or a new one in each frame."""
    noise_correlation_s: DurationS = 10.0
    """Correlation time of autoregressive pose errors, seconds."""
    odometry_drift: bool = True
    """Odometry of all agents drifts by a random walk of 0.02 m and 0.02° per square root of a second, instead of being true; in
    'manyeyes evaluate' only with pose errors."""

    def make_pose_noise(self, seed: int) -> PoseNoise:
        """Return errors of this kind at level 0; ``PoseNoise.at_level`` scales them."""
        from manyeyes.datasets.perturbation import PoseNoise

        return PoseNoise(
            seed=seed,
            in_time=self.noise_in_time,
            claim=self.claimed_covariance,
            correlation_time_s=self.noise_correlation_s,
        )

    def make_odometry_drift(self, seed: int) -> OdometryDrift | None:
        """Return the drift; None where odometry is true."""
        from manyeyes.datasets.odometry_drift import OdometryDrift

        return OdometryDrift(seed=seed) if self.odometry_drift else None

    def describe(self, seed: int) -> str:
        """Return the note under tables."""
        drift = self.make_odometry_drift(seed)
        odometry = "true" if drift is None else drift.description
        return f"Pose errors: {self.make_pose_noise(seed).description}. Odometry: {odometry}."
