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
from manyeyes.pose.corrector import DOUBTFUL, REFUTED
from manyeyes.pose.types import PoseClaim, PoseEstimate, difference

Floats = NDArray[np.float64]


class Health(Enum):
    """UNKNOWN: objects have not yet said enough. SOUND: objects and claim agree. DOUBTFUL: in this frame they agree
    badly, as one honest frame in twenty does. OFFSET: the claim is off. DRIFTING: it moves off.
    """

    UNKNOWN = "unknown"
    SOUND = "sound"
    DOUBTFUL = "doubtful"
    OFFSET = "offset"
    DRIFTING = "drifting"


@dataclass(frozen=True)
class WatchConfig:
    """frames: how many measured frames are remembered. lasting: of how many an offset is the mean. least: how many a drift
    needs. single, doubtful, drift: limits of the tests, squared and in standard deviations: 16.27 is p = 0.001 of one
    frame; 4.5 of a slope names fewer than one sound agent in twenty in half a minute at 10 Hz.
    """

    frames: int = 100
    lasting: int = 30
    least: int = 20
    single: float = REFUTED
    doubtful: float = DOUBTFUL
    drift: float = 4.5

    def __post_init__(self) -> None:
        fits = 3 <= self.least <= self.frames and 1 <= self.lasting <= self.frames
        if not fits or min(self.single, self.doubtful, self.drift) <= 0:
            raise ConfigError("WatchConfig needs 3 <= least <= frames, 1 <= lasting <= frames and limits above 0.")


@dataclass(frozen=True)
class WatchState:
    """Innovations (N, 3) of the last measured frames, oldest first, their covariances (N, 3, 3) without and (N, 3, 3)
    with the claim's, and their times (N,) in seconds.
    """

    innovation: Floats
    measured: Floats
    claimed: Floats
    time: Floats

    @classmethod
    def new(cls) -> WatchState:
        """Nothing seen yet."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0))


@dataclass(frozen=True)
class Report:
    """health, and what it rests on: distance, squared, of the mean innovation; drift: metres per second, x and y, and
    radians per second of yaw (3,); drift_sigmas: its size in standard deviations; frames: measured frames in memory.
    """

    health: Health
    distance: float
    drift: Floats
    drift_sigmas: float
    frames: int


def watch(
    state: WatchState,
    estimate: PoseEstimate,
    claimed: PoseClaim | None,
    time_s: float,
    config: WatchConfig | None = None,
) -> tuple[WatchState, Report]:
    """The state after one more frame, and what it says. A frame in which objects gave no pose changes nothing."""
    config = config or WatchConfig()
    if claimed is not None and estimate.measured is not None and estimate.measured_covariance is not None:
        last = state.time[-1] if len(state.time) else -np.inf
        if not time_s > last:
            raise ConfigError(f"watch needs growing times; {time_s} s came after {last} s.")
        state = WatchState(
            np.concatenate((state.innovation, difference(estimate.measured, claimed.pose)[None]))[-config.frames :],
            np.concatenate((state.measured, estimate.measured_covariance[None]))[-config.frames :],
            np.concatenate((state.claimed, claimed.covariance[None]))[-config.frames :],
            np.append(state.time, time_s)[-config.frames :],
        )
    return state, _report(state, config)


def _report(state: WatchState, config: WatchConfig) -> Report:
    n = len(state.time)
    if not n:
        return Report(Health.UNKNOWN, float("nan"), np.zeros(3), 0.0, 0)
    drift, sigmas = _slope(state, config.least) if n >= config.least else (np.zeros(3), 0.0)
    now = _distance(state.innovation[-1], state.measured[-1] + state.claimed[-1])
    # The claim's error may be one for all frames, so that only the measurements average out.
    weight = np.linalg.inv(state.measured[-config.lasting :])
    joint = np.linalg.inv(weight.sum(0))
    mean = joint @ np.einsum("nab,nb->a", weight, state.innovation[-config.lasting :])
    lasting = _distance(mean, joint + state.claimed[-config.lasting :].mean(0))
    health = Health.DOUBTFUL if now > config.doubtful else Health.SOUND
    if max(now, lasting) > config.single:
        health = Health.OFFSET
    if sigmas > config.drift:
        health = Health.DRIFTING
    return Report(health, max(now, lasting), drift, sigmas, n)


def _slope(state: WatchState, least: int) -> tuple[Floats, float]:
    """Slope (3,) per second of the line through the innovations that is level and then rises, for at least so many frames;
    and its size in standard deviations: of the way over the ground, or of the turn, whichever is larger.

    The spread is the larger of what the measurements state and what the innovations show, so that a claim whose
    errors are drawn anew in each frame is not taken for one that moves.
    """
    n = len(state.time)
    begins = state.time[: n - least + 1]
    rising = np.maximum(state.time - begins[:, None], 0.0)
    rising -= rising.mean(1, keepdims=True)
    span = np.square(rising).sum(1, keepdims=True)
    slope = rising @ state.innovation / span
    whole = np.square(state.innovation - state.innovation.mean(0)).sum(0)
    shown = (whole - np.square(slope) * span) / (n - 2)
    stated = np.diagonal(state.measured, axis1=1, axis2=2).mean(0)
    squared = np.square(slope) * span / np.maximum(shown, stated)
    sigmas = np.sqrt(np.maximum(squared[:, 0] + squared[:, 1], squared[:, 2]))
    best = int(sigmas.argmax())
    return slope[best], float(sigmas[best])


def _distance(delta: Floats, covariance: Floats) -> float:
    return float(delta @ np.linalg.solve(covariance, delta))
