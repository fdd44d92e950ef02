# SPDX-License-Identifier: Apache-2.0
"""Estimate over time where a vehicle is in its own frame, from the boxes in which another agent detects it.

A format may put an agent's frame at the middle of its vehicle, at its rear axle or under its sensor, and not state which. The
relative pose is fitted to all pairs of objects except the two vehicles themselves, so that an assumed place of a body does not
confirm itself. The box in which the observer detects the vehicle, moved into the vehicle's frame by that pose, is one measurement
of a constant. Measurements soon after each other have the same error of the detector, and count for less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import AgentBody, ConfigError
from manyeyes.pose.landmarks import (
    KNOWN_BODY_UNCERTAINTY,
    UNKNOWN_BODY_SIZE_M,
    UNKNOWN_BODY_UNCERTAINTY,
    DetectorUncertainty,
    Landmarks,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_HEIGHT_M = 1.6


@dataclass(frozen=True)
class BodyConfig:
    """min_pairs: pairs of other objects that a measurement needs. max_offset_m, max_turn_rad: of a box from the frame, its heading
    modulo pi. gate: largest squared distance from the estimate so far, 2 degrees of freedom, 9.21 is p = 0.01. correlation_s: time
    after which two measurements are independent but for 1 / e. floor_m: error that all of them have in common.
    """

    min_pairs: int = 3
    max_offset_m: float = 3.5
    max_turn_rad: float = 0.3
    gate: float = 9.21
    correlation_s: float = 1.0
    floor_m: float = 0.1

    def __post_init__(self) -> None:
        if self.min_pairs < 2 or min(self.max_offset_m, self.max_turn_rad, self.gate, self.correlation_s) <= 0:
            raise ConfigError(
                "BodyConfig needs min_pairs >= 2, and max_offset_m, max_turn_rad, gate and correlation_s above 0."
            )


@dataclass(frozen=True)
class BodyEstimate:
    """xy: (2,) middle of a vehicle in its own frame (m); covariance: (2, 2), without the common error. size: (2,) length and width
    (m), the mean of num_measurements. time_s: of the last measurement.
    """

    xy: Floats
    covariance: Floats
    size: Floats
    num_measurements: int
    time_s: float

    def sigma_m(self, config: BodyConfig | None = None) -> float:
        """Return the standard deviation along the less certain axis, with the common error."""
        floor_m = (config or BodyConfig()).floor_m
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance)[-1]) + floor_m**2)


_START = BodyEstimate(
    np.zeros(2), UNKNOWN_BODY_UNCERTAINTY.sigma_xy_m**2 * np.eye(2), np.array(UNKNOWN_BODY_SIZE_M), 0, -math.inf
)
"""A car near the origin, before any measurement."""


def append_body(landmarks: Landmarks, body: AgentBody | None, estimate: BodyEstimate | None) -> Landmarks:
    """Append the vehicle that carries the sensor, at its stated place, else at the estimated one, else near the origin."""
    if body is not None or estimate is None:
        return landmarks.with_body(body)
    known = KNOWN_BODY_UNCERTAINTY
    uncertainty = DetectorUncertainty(
        max(estimate.sigma_m(), known.sigma_xy_m), UNKNOWN_BODY_UNCERTAINTY.sigma_yaw_rad, known.p_flip
    )
    x, y = map(float, estimate.xy)
    length, width = map(float, estimate.size)
    return landmarks.with_body(AgentBody.standing(x, y, (length, width, _HEIGHT_M)), uncertainty)


def update_body(
    before: BodyEstimate | None,
    observer: Landmarks,
    subject: Landmarks,
    pairs: Ints,
    time_s: float,
    config: BodyConfig | None = None,
) -> BodyEstimate | None:
    """Return the estimate with the box in which an observer detects a vehicle; unchanged where there is none.

    Before the first box it is None.

    Args:
        before: the estimate so far. observer, subject: objects that both detect, each in its own frame, without their own vehicles.
        pairs: (P, 2) rows of observer and subject that a corrector found; rows of appended vehicles are left out.
        time_s: of both.
    """
    config, prior = config or BodyConfig(), before or _START
    is_object = (pairs[:, 0] < len(observer)) & (pairs[:, 1] < len(subject))
    pairs = pairs[is_object]
    if len(pairs) < config.min_pairs or not time_s > prior.time_s:
        return before
    pose, covariance = _fit(observer, subject, pairs)
    rest = np.setdiff1d(np.arange(len(observer)), pairs[:, 0])
    moved = observer[rest].transform(pose)
    turn = np.abs(np.remainder(moved.yaw + np.pi / 2, np.pi) - np.pi / 2)
    rows = np.flatnonzero((np.hypot(*moved.xy.T) < config.max_offset_m) & (turn < config.max_turn_rad))
    if not len(rows):
        return before
    row = rows[np.argmin(np.hypot(*(moved.xy[rows] - prior.xy).T))]
    measured = moved.xy[row]
    lever = np.array([[1.0, 0.0, -(measured[1] - pose[1])], [0.0, 1.0, measured[0] - pose[0]]])
    variance = lever @ covariance @ lever.T + moved.sigma_xy[row] ** 2 * np.eye(2)
    innovation = measured - prior.xy
    joint = prior.covariance + variance
    if innovation @ np.linalg.solve(joint, innovation) > config.gate:
        return before
    # A measurement right after another one adds no information.
    weight = max(1.0 - math.exp(-(time_s - prior.time_s) / config.correlation_s), 1e-3)
    gain = np.linalg.solve(prior.covariance + variance / weight, prior.covariance).T
    rest_of = np.eye(2) - gain
    updated = rest_of @ prior.covariance @ rest_of.T + gain @ (variance / weight) @ gain.T
    count = prior.num_measurements + 1
    size = prior.size + (moved.size[row] - prior.size) / count
    return BodyEstimate(prior.xy + gain @ innovation, updated, size, count, time_s)


def _fit(observer: Landmarks, subject: Landmarks, pairs: Ints) -> tuple[Floats, Floats]:
    """Return subject_from_observer (3,) of weighted least squares on positions, and its covariance (3, 3) by stated errors."""
    i, k = pairs.T
    weight = 1.0 / (observer.sigma_xy[i] ** 2 + subject.sigma_xy[k] ** 2)
    source, target = observer.xy[i], subject.xy[k]
    middle, aim = (np.average(x, axis=0, weights=weight) for x in (source, target))
    p, q = source - middle, target - aim
    sine, cosine = (weight * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])).sum(), (weight * (p * q).sum(1)).sum()
    yaw = math.atan2(sine, cosine)
    c, s = math.cos(yaw), math.sin(yaw)
    shift = aim - np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    # Error of the shift and of the turn about the aim, then as that of x, y and yaw.
    spread = max(float((weight * (q * q).sum(1)).sum()), 1e-9)
    about = np.diag([1 / weight.sum(), 1 / weight.sum(), 1 / spread])
    arm = shift - aim
    lever = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
    return np.array([*shift, yaw]), lever @ about @ lever.T
