# SPDX-License-Identifier: Apache-2.0
"""Whom to believe, and how much: agents whose claims are off alike, observations that say the same again, and the one error
that all claims around share.
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
"""Not 0: what only one saw whom nobody believes has a place still."""


def compute_observability(covariance: Floats, prior_covariance: Floats) -> Floats:
    """(O, 2, 2) from 0 (the lines tell nothing of the place in that direction) to the identity, for poses of that
    covariance (O, 3, 3) whose places were claimed with ``prior_covariance`` (O, 2, 2).
    """
    observability = np.eye(2) - covariance[:, :2, :2] @ np.linalg.inv(prior_covariance)
    return (observability + observability.transpose(0, 2, 1)) / 2


def estimate_agent_weights(
    offset: Floats, observability: Floats, prior_variance: Floats, agent: Ints, limits: tuple[float, float, float]
) -> Floats:
    """(O,) in (0, 1]: small for agents whose claims are off alike, in the directions that lines told.

    offset: (O, 2) metres that an observation was moved more than others around; prior_variance: (O,) of its claim. limits: by
    how many sigmas off an agent counts little, and next to nothing; which part of the variance is one error of the agent.

    The mean over an agent's observations tells more than any one of them: their own noise averages out, the agent's
    common error and its lie do not.
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
    """(O, 2) metres by which the observations around each one were moved alike, which nothing but chance explains.

    poses: start and corrected pose (O, 3); weight: (O,) what each correction has to say; prior_variance: (O,) of its claim;
    gauge: metres around, and sigmas beyond which a correction has little say.

    Lines tell where observations stand to each other; where all of them stand is told by their claims alone, whose
    errors have no common direction. So the mode of the corrections around is an error of all, and is taken back. It is
    a mode, not a mean: a fifth of agents who lie alike do not move it far. Each correction counts in the directions
    that lines told; one that the gross search moved does not.
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
    keys, start, order = grid
    radius, scale = params
    out = np.zeros((len(place), 2))
    for o in range(len(place)):
        ix, iy = int(np.floor(place[o, 0] / radius)), int(np.floor(place[o, 1] / radius))
        x, y = 0.0, 0.0
        for turn in range(6):
            # The scale narrows from where everything counts.
            c2 = (scale * max(1.0, 4.0 - turn)) ** 2
            # One quiet observation more, so that the mode of few is not a rumour.
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
    """(O,) how much an observation's lines weigh for others: surveyed poles much, agents with odd lines and repeated
    looks little.
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
    """How many looks of the same agent stand within a radius, each counted by 1 - (distance / radius)²; itself counts
    1.
    """
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
