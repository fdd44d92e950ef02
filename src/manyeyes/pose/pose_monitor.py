# SPDX-License-Identifier: Apache-2.0
"""Watches whether an agent's claimed pose stays true: one refuted frame, a lasting offset, a drift.

What is watched is the innovation: where objects put the agent less where it says it is, in its own claimed
covariance's axes. One frame is a chi^2 test; a lasting offset that each frame alone would forgive is the mean of the
last frames, again by chi^2; a drift is the slope of a line that begins at some frame and before it was level, which an
offset that the claim's own error explains does not hide. What was seen before it tells where the line begins, so that a
drift is named far sooner than its own frames alone would allow. Pure functions: the state is the caller's.
Spec: specs/pose.md 4.4, its "infrastructure status"; FeaKM's paper asks for it and has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import ConfigError
from manyeyes.pose.corrector import CHI2_3DOF_P001, CHI2_3DOF_P05
from manyeyes.pose.types import PoseEstimate, PosePrior, pose_difference

Floats = NDArray[np.float64]


class PoseHealth(Enum):
    """UNKNOWN: objects have not yet said enough. SOUND: objects and claim agree. SUSPECT: in this frame they agree
    badly, as one honest frame in twenty does. OFFSET: the claim is off. DRIFTING: it moves off.
    """

    UNKNOWN = "unknown"
    SOUND = "sound"
    SUSPECT = "suspect"
    OFFSET = "offset"
    DRIFTING = "drifting"


@dataclass(frozen=True)
class PoseMonitorConfig:
    """max_frames: how many measured frames are remembered. offset_window: of how many an offset is the mean. min_drift_frames: how
    many a drift needs. offset_gate, suspect_gate, drift_gate_sigmas: limits of the tests, squared and in standard deviations: 16.27
    is p = 0.001 of one frame; 4.5 of a slope names fewer than one sound agent in twenty in half a minute at 10 Hz.
    """

    max_frames: int = 100
    offset_window: int = 30
    min_drift_frames: int = 20
    offset_gate: float = CHI2_3DOF_P001
    suspect_gate: float = CHI2_3DOF_P05
    drift_gate_sigmas: float = 4.5

    def __post_init__(self) -> None:
        fits = 3 <= self.min_drift_frames <= self.max_frames and 1 <= self.offset_window <= self.max_frames
        if not fits or min(self.offset_gate, self.suspect_gate, self.drift_gate_sigmas) <= 0:
            raise ConfigError(
                "PoseMonitorConfig needs 3 <= min_drift_frames <= max_frames, 1 <= offset_window <= max_frames and gates above 0."
            )


@dataclass(frozen=True)
class PoseMonitorState:
    """Innovations (N, 3) of the last measured frames, oldest first, their covariances (N, 3, 3) without and (N, 3, 3)
    with the claim's, and their times (N,) in seconds.
    """

    innovation: Floats
    measured_covariance: Floats
    prior_covariance: Floats
    time_s: Floats

    @classmethod
    def new(cls) -> PoseMonitorState:
        """Nothing seen yet."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0))


@dataclass(frozen=True)
class PoseReport:
    """health, and what it rests on: distance, squared, of the mean innovation; drift_per_s: metres per second, x and y, and
    radians per second of yaw (3,); drift_sigmas: its size in standard deviations; num_frames: measured frames in memory.
    """

    health: PoseHealth
    mahalanobis_squared: float
    drift_per_s: Floats
    drift_sigmas: float
    num_frames: int


def update_monitor(
    state: PoseMonitorState,
    estimate: PoseEstimate,
    prior: PosePrior | None,
    time_s: float,
    config: PoseMonitorConfig | None = None,
) -> tuple[PoseMonitorState, PoseReport]:
    """The state after one more frame, and what it says. A frame in which objects gave no pose changes nothing."""
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
    drift, sigmas = _slope(state, config.min_drift_frames) if n >= config.min_drift_frames else (np.zeros(3), 0.0)
    now = _distance(state.innovation[-1], state.measured_covariance[-1] + state.prior_covariance[-1])
    # The claim's error may be one for all frames, so that only the measurements average out.
    weight = np.linalg.inv(state.measured_covariance[-config.offset_window :])
    joint = np.linalg.inv(weight.sum(0))
    mean = joint @ np.einsum("nab,nb->a", weight, state.innovation[-config.offset_window :])
    mean_distance = _distance(mean, joint + state.prior_covariance[-config.offset_window :].mean(0))
    health = PoseHealth.SUSPECT if now > config.suspect_gate else PoseHealth.SOUND
    if max(now, mean_distance) > config.offset_gate:
        health = PoseHealth.OFFSET
    if sigmas > config.drift_gate_sigmas:
        health = PoseHealth.DRIFTING
    return PoseReport(health, max(now, mean_distance), drift, sigmas, n)


def _slope(state: PoseMonitorState, min_frames: int) -> tuple[Floats, float]:
    """Slope (3,) per second of the line through the innovations that is level and then rises, for at least so many frames;
    and its size in standard deviations: of the way over the ground, or of the turn, whichever is larger.

    The spread is the larger of what the measurements state and what the innovations show, so that a claim whose
    errors are drawn anew in each frame is not taken for one that moves.
    """
    n = len(state.time_s)
    begins = state.time_s[: n - min_frames + 1]
    rising = np.maximum(state.time_s - begins[:, None], 0.0)
    rising -= rising.mean(1, keepdims=True)
    span = np.square(rising).sum(1, keepdims=True)
    slope = rising @ state.innovation / span
    whole = np.square(state.innovation - state.innovation.mean(0)).sum(0)
    shown = (whole - np.square(slope) * span) / (n - 2)
    stated = np.diagonal(state.measured_covariance, axis1=1, axis2=2).mean(0)
    squared = np.square(slope) * span / np.maximum(shown, stated)
    sigmas = np.sqrt(np.maximum(squared[:, 0] + squared[:, 1], squared[:, 2]))
    best = int(sigmas.argmax())
    return slope[best], float(sigmas[best])


def _distance(delta: Floats, covariance: Floats) -> float:
    return float(delta @ np.linalg.solve(covariance, delta))
