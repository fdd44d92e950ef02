# SPDX-License-Identifier: Apache-2.0
"""Velocity estimation of detected boxes from the boxes and points of the agent's last sweeps.

A detector regresses velocity from two sweeps 100 ms apart, where 10 cm of position error are 1 m/s. Half a second of associated
boxes is more accurate. A line is fitted to the positions of each box by weighted least squares, with the detected velocity and the
motion along the vehicle's length as a prior (MAP estimate of a Gaussian linear model: Bishop, Pattern Recognition and Machine
Learning, 2006, section 3.3). The velocity is then refined by a search around the fit for the minimum alignment cost between the
box's points of this sweep and of earlier ones (``ops.point_alignment_cost``). Insignificant velocities are set to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manyeyes.datatypes import Boxes
from manyeyes.ops.point_alignment_cost import MAX_POINTS, compute_alignment_costs

LONGITUDINAL_SIGMAS = torch.linspace(-3.0, 3.0, 31)
"""Longitudinal search offsets, in standard deviations of the line fit."""


@dataclass(frozen=True)
class VelocityConfig:
    """Limits and standard deviations of velocity estimation.

    gate_m: association gate. sigma_position_m: of a centre between sweeps, in addition to the detector's own sigma_xy.
    sigma_detected_velocity_mps: of the detector's velocity. sigma_lateral_velocity_mps: of motion across a vehicle's length.
    point_match_window_s: ages of the sweeps whose points are aligned; point_match_weight: cost of an object of many points without
    any aligned point, in units of half a squared standard deviation. min_z_score, min_speed_mps: lower velocities are set to 0.
    """

    gate_m: float = 2.0
    sigma_position_m: float = 0.15
    sigma_detected_velocity_mps: float = 3.0
    sigma_lateral_velocity_mps: float = 0.2
    point_match_window_s: tuple[float, float] = (0.15, 0.35)
    point_match_weight: float = 80.0
    min_z_score: float = 0.7
    min_speed_mps: float = 0.5


DEFAULT_VELOCITY_CONFIG = VelocityConfig()
"""Default settings of every agent; chosen on Town07."""


@dataclass(frozen=True)
class PastDetections:
    """Detections of an earlier frame, in the current frame: boxes, and points (Q, 3) float32 where points are aligned."""

    boxes: Boxes
    age_s: float
    points: Tensor | None = None


def estimate_velocities(
    boxes: Boxes, past: Sequence[PastDetections], config: VelocityConfig, points: Tensor | None = None
) -> Tensor:
    """Return (N, 2) m/s of boxes, in their frame, from earlier detections, newest first; the detector's velocity without
    association.

    Boxes are associated as mutual nearest neighbours of the propagated positions, within the gate. points: (P, 3) float32 of this
    sweep; None uses boxes only.
    """
    if not len(boxes):
        return boxes.velocity
    line = _LineFit.from_boxes(boxes, config)
    for then in past:
        if len(then.boxes):
            distance = torch.cdist(line.position_at(-then.age_s), then.boxes.center[:, :2])
            nearest = distance.argmin(1)
            mutual = distance.argmin(0)[nearest] == torch.arange(len(boxes))
            same = mutual & (distance.gather(1, nearest[:, None])[:, 0] <= config.gate_m)
            line = line.add(then.boxes[nearest], -then.age_s, same)
    information, velocity, associated = line.information, line.velocity, line.sums[:, 2] > 0
    if points is not None:
        matched = _match_points(boxes[associated], velocity[associated], information[associated], past, points, config)
        velocity = velocity.index_put((associated,), matched)
    significant = (velocity[:, None] @ information @ velocity[:, :, None])[:, 0, 0] >= config.min_z_score**2
    moves = significant & (velocity.norm(dim=1) >= config.min_speed_mps)
    return torch.where(associated[:, None], velocity * moves[:, None], boxes.velocity)


def _match_points(
    boxes: Boxes,
    velocity: Tensor,
    information: Tensor,
    past: Sequence[PastDetections],
    points: Tensor,
    config: VelocityConfig,
) -> Tensor:
    """Return velocities (N, 2) of minimum alignment cost around the given ones; information: as in _LineFit."""
    longitudinal = torch.stack((boxes.yaw.cos(), boxes.yaw.sin()), 1)
    variance = (longitudinal[:, None] @ torch.linalg.inv(information) @ longitudinal[:, :, None])[:, 0, 0]
    sigma = variance.sqrt().clamp_max(config.sigma_detected_velocity_mps)
    cost = (LONGITUDINAL_SIGMAS**2).to(velocity.dtype).expand(len(boxes), -1)
    for then in past:
        if then.points is not None:
            t = then.age_s
            missed, num_compared = compute_alignment_costs(
                points, then.points, boxes, velocity * t, LONGITUDINAL_SIGMAS[-1] * sigma * t, len(LONGITUDINAL_SIGMAS)
            )
            cost = cost + config.point_match_weight * (num_compared / MAX_POINTS)[:, None] * missed
    return velocity + (sigma * LONGITUDINAL_SIGMAS[cost.argmin(1)])[:, None] * longitudinal


@dataclass(frozen=True)
class _LineFit:
    """N lines through box positions, as the sums of least squares. Times are relative to now, positions to each box.

    sums: (N, 3), over places, of w, w t, w t^2 with w the inverse variance of a place; moments: (N, 2, 2) of w p, w t p.
    prior_information: (N, 2, 2), inverse covariance of the velocity beforehand; prior_vector: (N, 2), it times the mean.
    """

    origin: Tensor
    sums: Tensor
    moments: Tensor
    prior_information: Tensor
    prior_vector: Tensor
    sigma_position_m: float

    @classmethod
    def from_boxes(cls, boxes: Boxes, config: VelocityConfig) -> _LineFit:
        """Return the fit of the current positions and the prior."""
        n, ahead = len(boxes), torch.stack((boxes.yaw.cos(), boxes.yaw.sin()), 1)
        longitudinal = ahead[:, :, None] * ahead[:, None, :]
        lateral = torch.eye(2) - longitudinal
        prior = longitudinal / config.sigma_detected_velocity_mps**2 + lateral / config.sigma_lateral_velocity_mps**2
        pull = (longitudinal @ boxes.velocity[:, :, None])[..., 0] / config.sigma_detected_velocity_mps**2
        empty = cls(boxes.center[:, :2], torch.zeros(n, 3), torch.zeros(n, 2, 2), prior, pull, config.sigma_position_m)
        return empty.add(boxes, 0.0, torch.ones(n, dtype=torch.bool))

    def add(self, boxes: Boxes, t: float, same: Tensor) -> _LineFit:
        """Return the fit with one more position for each associated box; same: (N,) bool."""
        weight = same / (self.sigma_position_m**2 + boxes.sigma_xy**2)
        powers = weight[:, None] * torch.tensor([1.0, t, t * t])
        moments = powers[:, :2, None] * (boxes.center[:, :2] - self.origin)[:, None]
        return replace(self, sums=self.sums + powers, moments=self.moments + moments)

    @property
    def information(self) -> Tensor:
        """(N, 2, 2): the inverse covariance of the velocity."""
        w, wt, wtt = self.sums.unbind(1)
        return self.prior_information + (wtt - wt * wt / w)[:, None, None] * torch.eye(2)

    @property
    def velocity(self) -> Tensor:
        """Estimated velocities (N, 2), m/s."""
        slope = self.moments[:, 1] - self.moments[:, 0] * (self.sums[:, 1] / self.sums[:, 0])[:, None]
        return torch.linalg.solve(self.information, self.prior_vector + slope)

    def position_at(self, t: float) -> Tensor:
        """Return positions (N, 2) of the boxes at time t."""
        w, wt = self.sums[:, 0, None], self.sums[:, 1, None]
        return self.origin + self.moments[:, 0] / w + self.velocity * (t - wt / w)
