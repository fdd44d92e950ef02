# SPDX-License-Identifier: Apache-2.0
"""Robust weights for the pose optimization: per agent, per observation, and the common (gauge) offset of all corrections.

An agent whose corrections share one direction by more than its prior covariance explains gets a small weight (M-estimation with
a Geman-McClure weight). Redundant observations of one agent share their weight. The gauge offset is a robust mode of the
corrections nearby.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from manyeyes._jit import F64x1, F64x2, F64x3, I64x1, njit
from manyeyes.maps.fusion.observation_arrays import ObservationArrays
from manyeyes.maps.fusion.point_grid import build_grid, find_cell_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

REJECTED_WEIGHT = 1e-6
"""Weight of a rejected agent; not 0, so that elements seen by such an agent alone still get a position."""


def compute_observability(covariance: Floats, prior_covariance: Floats) -> Floats:
    """Compute how well the lines determine each position: (O, 2, 2), from 0 (not at all) to the identity.

    covariance: (O, 3, 3) of the corrected poses. prior_covariance: (O, 2, 2) of the prior positions.
    """
    observability = np.eye(2) - covariance[:, :2, :2] @ np.linalg.inv(prior_covariance)
    return (observability + observability.transpose(0, 2, 1)) / 2


def estimate_agent_weights(
    offset: Floats, observability: Floats, prior_variance: Floats, agent: Ints, limits: tuple[float, float, float]
) -> Floats:
    """Estimate agent weights (O,) in (0, 1] from the mean correction of each agent's prior poses (robust M-estimation).

    The mean over an agent's observations is used because independent noise averages out, while a bias or an attack does not.
    Only observable directions count.

    Args:
        offset: (O, 2) metres, correction of each observation relative to those nearby.
        observability: (O, 2, 2), see :func:`compute_observability`.
        prior_variance: (O,) m², mean variance of the prior position.
        agent: (O,) agent of each observation, from 0.
        limits: Geman-McClure scale and rejection limit, both in standard deviations; fraction of the prior variance that is
            common to a drive.
    """
    count = int(agent.max(initial=-1)) + 1
    scale, limit, drive_correlation = limits
    weight, pull, prior_sum, num_observations = (
        np.zeros((count, 2, 2)),
        np.zeros((count, 2)),
        np.zeros(count),
        np.zeros(count),
    )
    np.add.at(weight, agent, observability)
    np.add.at(pull, agent, np.einsum("oij,oj->oi", observability, offset))
    np.add.at(prior_sum, agent, prior_variance)
    np.add.at(num_observations, agent, 1.0)
    mean = np.linalg.solve(weight + 0.1 * np.eye(2), pull[:, :, None])[:, :, 0]
    spread = (
        prior_sum
        / num_observations
        * (1.0 + drive_correlation * (np.trace(weight, axis1=1, axis2=2) / 2 - 1.0).clip(0.0))
    )
    distance = np.einsum("ai,aij,aj->a", mean, weight, mean).clip(0.0) / np.maximum(spread, 1e-12)
    return np.where(distance > limit**2, REJECTED_WEIGHT, (scale**2 / (scale**2 + distance)) ** 2)[agent]


def estimate_gauge_offset(
    poses: tuple[Floats, Floats],
    observability: Floats,
    weight: Floats,
    prior_variance: Floats,
    gauge: tuple[float, float],
) -> Floats:
    """Estimate the offset (O, 2) in metres that all corrections around each observation share.

    Lines determine only relative positions. The absolute position follows from the prior poses, whose errors have no common
    direction. So a shared correction is an error of the solution and is subtracted. It is estimated as a mode, which a fifth of
    colluding agents shifts little. Each correction counts in its observable directions.

    Args:
        poses: initial and corrected pose (O, 3).
        observability: (O, 2, 2), see :func:`compute_observability`.
        weight: (O,) of each correction; 0 excludes it.
        prior_variance: (O,) m², mean variance of the prior position.
        gauge: radius in metres, and Geman-McClure scale in standard deviations.
    """
    start, pose = poses
    grid = build_grid(start[:, 0], start[:, 1], np.zeros(len(observability), np.int64), gauge[0])
    return _find_modes(
        start,
        pose[:, :2] - start[:, :2],
        observability,
        weight,
        np.sqrt(prior_variance),
        (grid.keys, grid.offsets, grid.order),
        gauge,
    )


@njit(cache=True, nogil=True)
def _find_modes(
    place: F64x2,
    correction: F64x2,
    observability: F64x3,
    weight: F64x1,
    sigma: F64x1,
    grid: tuple[I64x1, I64x1, I64x1],
    params: tuple[float, float],
) -> F64x2:  # pragma: no cover - compiled
    """Find the mode (O, 2) of the corrections (O, 2) within a radius of each place by iteratively reweighted least squares."""
    keys, start, order = grid
    radius, scale = params
    out = np.zeros((len(place), 2))
    for o in range(len(place)):
        ix, iy = int(np.floor(place[o, 0] / radius)), int(np.floor(place[o, 1] / radius))
        x, y = 0.0, 0.0
        for turn in range(6):
            # The scale narrows from a value at which all observations count (graduated non-convexity).
            c2 = (scale * max(1.0, 4.0 - turn)) ** 2
            # A prior observation at 0 damps the mode where only few observations are near.
            xx, xy, yy, bx, by = 1.0, 0.0, 1.0, 0.0, 0.0
            for dx in range(-1, 2):
                low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
                for k in range(low, high):
                    q = order[k]
                    far = ((place[q, 0] - place[o, 0]) ** 2 + (place[q, 1] - place[o, 1]) ** 2) / radius**2
                    if far >= 1.0 or weight[q] <= 0.0:
                        continue
                    t = observability[q]
                    ex, ey = correction[q, 0] - x, correction[q, 1] - y
                    m2 = (ex * (t[0, 0] * ex + t[0, 1] * ey) + ey * (t[0, 1] * ex + t[1, 1] * ey)) / sigma[q] ** 2
                    g = c2 / (c2 + max(0.0, m2))
                    w = weight[q] * (1.0 - far) ** 2 * g * g
                    xx += w * t[0, 0]
                    xy += w * t[0, 1]
                    yy += w * t[1, 1]
                    bx += w * (t[0, 0] * correction[q, 0] + t[0, 1] * correction[q, 1])
                    by += w * (t[0, 1] * correction[q, 0] + t[1, 1] * correction[q, 1])
            determinant = xx * yy - xy * xy
            x, y = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
        out[o, 0], out[o, 1] = x, y
    return out


def compute_observation_weights(
    arrays: ObservationArrays, initial_pose: Floats, scale: Floats, agent_weight: Floats, radius_m: float = 30.0
) -> Floats:
    """Compute the weight (O,) of each observation's lines in the residuals of other observations.

    Surveyed poles have weight 50. Other weights fall with the residual scale (O,) in metres, with the agent weight (O,), and
    with the number of observations of the same agent within ``radius_m``.
    """
    grid = build_grid(initial_pose[:, 0], initial_pose[:, 1], np.zeros(len(initial_pose), np.int64), radius_m)
    num_redundant = _count_same_agent(
        initial_pose, np.asarray(arrays.agent), grid.keys, grid.offsets, grid.order, radius_m
    )
    scale_weight = 1.0 / (1.0 + (scale / 0.2) ** 4)
    return np.where(arrays.trusted, 50.0, 2.0 * scale_weight * agent_weight / num_redundant)


@njit(cache=True, nogil=True)
def _count_same_agent(
    pose: F64x2, agent: I64x1, keys: I64x1, start: I64x1, order: I64x1, radius: float
) -> F64x1:  # pragma: no cover - compiled
    """Count observations (O,) of the same agent within a radius, each weighted by 1 - (distance / radius)²; itself counts 1."""
    counts = np.zeros(len(pose))
    for o in range(len(pose)):
        ix, iy = int(np.floor(pose[o, 0] / radius)), int(np.floor(pose[o, 1] / radius))
        for dx in range(-1, 2):
            low, high = find_cell_range(keys, start, 0, ix + dx, iy - 1, iy + 1)
            for q in range(low, high):
                other = order[q]
                if agent[other] == agent[o]:
                    d = ((pose[other, 0] - pose[o, 0]) ** 2 + (pose[other, 1] - pose[o, 1]) ** 2) / radius**2
                    counts[o] += max(0.0, 1.0 - d)
    return counts
