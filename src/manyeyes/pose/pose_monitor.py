# SPDX-License-Identifier: Apache-2.0
"""Monitor an agent's reported poses over time: an outlier in one frame, a lasting offset, a drift.

The monitored quantity is the innovation: the pose measured from objects less the prior, in the axes of the prior's
covariance. One frame is tested by chi^2. A lasting offset, too small to fail in single frames, is tested by chi^2 of the mean
over the last frames. A drift is a line that is level up to some frame and rises after it (drift_test.py), so that a constant error
of the prior does not hide it. Earlier frames fix the level, so that a drift is detected sooner than from its own frames alone.
Errors of successive frames are correlated; the correlation is estimated with the drift, and the mean over n frames counts as
n (1 - r) / (1 + r) independent ones. Pure functions: the state belongs to the caller.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import CHI2_3DOF_P001, CHI2_3DOF_P05
from manyeyes.pose.drift_test import DriftTest, find_drift
from manyeyes.pose.types import PoseEstimate, PosePrior, pose_difference

Floats = NDArray[np.float64]


class PoseHealth(Enum):
    """UNKNOWN: no measurement yet. SOUND: measurement and prior agree. SUSPECT: this frame fails at p = 0.05, as one sound
    frame in twenty does. OFFSET: the prior has an offset. DRIFTING: its error grows.
    """

    UNKNOWN = "unknown"
    SOUND = "sound"
    SUSPECT = "suspect"
    OFFSET = "offset"
    DRIFTING = "drifting"


@dataclass(frozen=True)
class PoseMonitorConfig:
    """max_frames: measured frames in memory. offset_window: frames over which an offset is averaged. min_drift_frames: frames that
    a drift lasts at least; twice as many are measured before it is tested. offset_gate, suspect_gate: limits of squared distances,
    16.27 is p = 0.001 of one frame. drift_gate_sigmas: limit of the drift; correlated_drift_gate_sigmas: the same where the
    estimated autocorrelation is at least min_high_correlation: such a window has fewer independent residuals, so that the largest
    of its frames and begins is smaller. At most one sound agent in a hundred is reported in half a minute at 10 Hz, whatever the
    autocorrelation of its errors (benchmarks/pose_drift.py).
    """

    max_frames: int = 200
    offset_window: int = 30
    min_drift_frames: int = 10
    offset_gate: float = CHI2_3DOF_P001
    suspect_gate: float = CHI2_3DOF_P05
    drift_gate_sigmas: float = 5.2
    correlated_drift_gate_sigmas: float = 4.9
    min_high_correlation: float = 0.75

    def __post_init__(self) -> None:
        fits = 3 <= self.min_drift_frames <= self.max_frames and 1 <= self.offset_window <= self.max_frames
        gates = self.offset_gate, self.suspect_gate, self.drift_gate_sigmas, self.correlated_drift_gate_sigmas
        if not fits or min(gates) <= 0:
            raise ConfigError(
                "PoseMonitorConfig needs 3 <= min_drift_frames <= max_frames, 1 <= offset_window <= max_frames and gates above 0."
            )

    def is_drift(self, found: DriftTest) -> NDArray[np.bool_]:
        """Return (...) bool: whether tests exceed the limit of their autocorrelation."""
        is_high = found.correlation >= self.min_high_correlation
        return found.sigmas > np.where(is_high, self.correlated_drift_gate_sigmas, self.drift_gate_sigmas)


@dataclass(frozen=True)
class PoseMonitorState:
    """Innovations (N, 3) of the last measured frames, oldest first; covariances (N, 3, 3) of the measurement and of the prior;
    times (N,) in seconds.
    """

    innovation: Floats
    measured_covariance: Floats
    prior_covariance: Floats
    time_s: Floats

    @classmethod
    def new(cls) -> PoseMonitorState:
        """Return the initial state, without measurements."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0))


@dataclass(frozen=True)
class PoseReport:
    """The health and its statistics. mahalanobis_squared: the larger of the last and the mean innovation's. drift_per_s: (3,)
    metres and radians per second; drift_sigmas: its size in standard deviations; num_frames: measured frames in memory.
    autocorrelation: of the innovations of successive frames, NaN before it is estimated.
    """

    health: PoseHealth
    mahalanobis_squared: float
    drift_per_s: Floats
    drift_sigmas: float
    num_frames: int
    autocorrelation: float = float("nan")


def update_monitor(
    state: PoseMonitorState,
    estimate: PoseEstimate,
    prior: PosePrior | None,
    time_s: float,
    config: PoseMonitorConfig | None = None,
) -> tuple[PoseMonitorState, PoseReport]:
    """Update the state with one frame and report the health; a frame without a measured pose changes nothing."""
    config = config or PoseMonitorConfig()
    if prior is not None and estimate.measured is not None and estimate.measured_covariance is not None:
        last = state.time_s[-1] if len(state.time_s) else -np.inf
        if not time_s > last:
            raise ConfigError(f"update_monitor needs growing times; {time_s} s came after {last} s.")
        state = PoseMonitorState(
            np.concatenate((state.innovation, pose_difference(estimate.measured, prior.pose)[None]))[
                -config.max_frames :
            ],
            np.concatenate((state.measured_covariance, estimate.measured_covariance[None]))[-config.max_frames :],
            np.concatenate((state.prior_covariance, prior.covariance[None]))[-config.max_frames :],
            np.append(state.time_s, time_s)[-config.max_frames :],
        )
    return state, _report(state, config)


def _report(state: PoseMonitorState, config: PoseMonitorConfig) -> PoseReport:
    n = len(state.time_s)
    if not n:
        return PoseReport(PoseHealth.UNKNOWN, float("nan"), np.zeros(3), 0.0, 0)
    stated = np.diagonal(state.measured_covariance, axis1=1, axis2=2).mean(0)
    drift, sigmas, correlation, is_drifting = np.zeros(3), 0.0, float("nan"), False
    if n >= max(2 * config.min_drift_frames, 3):
        found = find_drift(state.innovation, state.time_s, stated, config.min_drift_frames)
        drift, sigmas, correlation = found.slope, float(found.sigmas), float(found.correlation)
        is_drifting = bool(config.is_drift(found))
    now = _distance(state.innovation[-1], state.measured_covariance[-1] + state.prior_covariance[-1])
    # The prior's error may be common to all frames, so that only the measurements average out.
    weight = np.linalg.inv(state.measured_covariance[-config.offset_window :])
    joint = np.linalg.inv(weight.sum(0))
    mean = joint @ np.einsum("nab,nb->a", weight, state.innovation[-config.offset_window :])
    # Until it is estimated, errors of successive frames count as one: they are often those of the same objects in the same view.
    is_known = n >= max(2 * config.min_drift_frames, 3)
    joint = joint * (min((1 + correlation) / (1 - correlation), len(weight)) if is_known else len(weight))
    mean_distance = _distance(mean, joint + state.prior_covariance[-config.offset_window :].mean(0))
    health = PoseHealth.SUSPECT if now > config.suspect_gate else PoseHealth.SOUND
    if max(now, mean_distance) > config.offset_gate:
        health = PoseHealth.OFFSET
    if is_drifting:
        health = PoseHealth.DRIFTING
    return PoseReport(health, max(now, mean_distance), drift, sigmas, n, correlation)


def _distance(delta: Floats, covariance: Floats) -> float:
    return float(delta @ np.linalg.solve(covariance, delta))
