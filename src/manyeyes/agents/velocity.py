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
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from manyeyes.agents._velocity_kernels import (
    BoxColumns,
    FitLimits,
    LineFits,
    PastColumns,
    choose_candidates,
    fit_lines,
    longitudinal_sigmas,
    significant_velocities,
)
from manyeyes.datatypes import Boxes, PointCloud, Transform
from manyeyes.ops.point_alignment_cost import MAX_POINTS, compute_alignment_costs, index_points

LONGITUDINAL_SIGMAS = np.linspace(-3.0, 3.0, 31)
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
    """Detections of an earlier frame. boxes: float32 on the CPU. points: of its sweep, float32; None aligns no points.

    now_from_then: from its frame to the current one; None: it is the same frame.
    """

    boxes: Boxes
    age_s: float
    points: PointCloud | None = None
    now_from_then: Transform | None = None


def estimate_velocities(
    boxes: Boxes, past: Sequence[PastDetections], config: VelocityConfig, points: Tensor | None = None
) -> Tensor:
    """Return (N, 2) m/s of boxes, in their frame, from earlier detections, newest first; the detector's velocity without
    association.

    Boxes are associated as mutual nearest neighbours of the propagated positions, within the gate. points: (P, 3) float32 of this
    sweep; None uses boxes only.
    """
    past = [then for then in past if len(then.boxes)]
    if not len(boxes) or not past:
        return boxes.velocity
    yaw, detected = boxes.yaw.float().numpy(), boxes.velocity.float().numpy()
    limits = FitLimits(
        config.gate_m,
        config.sigma_position_m,
        config.sigma_detected_velocity_mps,
        config.sigma_lateral_velocity_mps,
    )
    fit = fit_lines(_columns([boxes]), yaw, detected, _past_columns(past), limits)
    if points is not None:
        _match_points(fit, boxes, past, points, config)
    velocity = significant_velocities(fit, detected, config.min_z_score, config.min_speed_mps)
    return torch.from_numpy(velocity).to(boxes.velocity.dtype)


def _columns(many: Sequence[Boxes]) -> BoxColumns:
    return BoxColumns(
        torch.cat([boxes.center for boxes in many]).float().numpy(),
        torch.cat([boxes.sigma_xy for boxes in many]).float().numpy(),
    )


def _past_columns(past: Sequence[PastDetections]) -> PastColumns:
    motions = np.zeros((len(past), 2, 4))
    motions[:, :, :2] = np.eye(2)
    for row, then in zip(motions, past):
        if then.now_from_then is not None:
            row[:, :3] = then.now_from_then.rotation[:2].numpy()
            row[:, 3] = then.now_from_then.translation[:2].numpy()
    start = np.cumsum([0, *(len(then.boxes) for then in past)])
    return PastColumns(_columns([then.boxes for then in past]), start, motions, np.array([then.age_s for then in past]))


def _match_points(
    fit: LineFits, boxes: Boxes, past: Sequence[PastDetections], points: Tensor, config: VelocityConfig
) -> None:
    """Change the associated velocities to those of minimum alignment cost around them."""
    first, last = config.point_match_window_s
    sweeps = [(then, then.points) for then in past if then.points is not None and first <= then.age_s <= last]
    if not sweeps or not fit.associated.any():
        return
    yaw, rows = boxes.yaw.float().numpy(), np.flatnonzero(fit.associated)
    sigma = longitudinal_sigmas(fit, yaw, config.sigma_detected_velocity_mps)
    cost = np.tile(LONGITUDINAL_SIGMAS**2, (len(boxes), 1))
    found, velocity = boxes[torch.from_numpy(rows)], torch.from_numpy(fit.velocity[rows])
    reach = torch.from_numpy(LONGITUDINAL_SIGMAS[-1] * sigma[rows])
    indexed = index_points(points)
    for then, earlier in sweeps:
        moved = earlier if then.now_from_then is None else earlier.transform(then.now_from_then)
        missed, num_compared = compute_alignment_costs(
            indexed, moved.xyz, found, velocity * then.age_s, reach * then.age_s, len(LONGITUDINAL_SIGMAS)
        )
        cost[rows] += (config.point_match_weight * (num_compared / MAX_POINTS)[:, None] * missed).numpy()
    choose_candidates(fit, yaw, sigma, LONGITUDINAL_SIGMAS, cost)
