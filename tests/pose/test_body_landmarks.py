# SPDX-License-Identifier: Apache-2.0
"""Two vehicles that see two common cars and each other: where each body is in its frame decides the match."""

from __future__ import annotations

import math

import numpy as np
import torch

from manyeyes.datatypes import AgentBody, Boxes, Transform
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import load_corrector
from manyeyes.pose.types import PosePrior

OFFSET_M, SEEDS = 1.5, range(12)
"""Distance of a body's middle from its frame's origin: the frame lies at the rear axle."""
BODY = AgentBody.standing(OFFSET_M, 0.0, (4.5, 1.9, 1.6))


def boxes(rows: np.ndarray) -> Boxes:
    """Cars at rows (N, 3) of x, y, yaw."""
    count = len(rows)
    center = torch.from_numpy(np.column_stack((rows[:, :2], np.full(count, 0.8))))
    return Boxes.of(center, torch.tensor([[4.5, 1.9, 1.6]]).double().repeat(count, 1), torch.from_numpy(rows[:, 2]))


def meet(seed: int) -> tuple[Boxes, Boxes, PosePrior, Transform]:
    """Return what each sees, in its own frame, a prior that is off by about 1 m, and the true pose of the second in the first."""
    rng = np.random.default_rng(seed)

    def cars(count: int, reach_m: float) -> np.ndarray:
        return np.column_stack((rng.uniform(-reach_m, reach_m, (count, 2)), rng.uniform(-3, 3, count)))

    def noise(count: int) -> np.ndarray:
        return np.column_stack((rng.normal(0, 0.15, (count, 2)), rng.normal(0, 0.02, count)))

    x, y, yaw = rng.uniform(12, 30), rng.uniform(-6, 6), rng.uniform(-math.pi, math.pi)
    ego_from_other = Transform.from_xyz_yaw(x, y, 0.0, yaw)
    second = np.array([[x + OFFSET_M * math.cos(yaw), y + OFFSET_M * math.sin(yaw), yaw]])
    common, first = cars(2, 20.0), np.array([[OFFSET_M, 0.0, 0.0]])
    seen = np.concatenate((common, cars(3, 30.0), second))
    by_other = np.concatenate((common, first))
    theirs = boxes(by_other + noise(3)).transform(ego_from_other.inverse())
    error = Transform.from_xyz_yaw(*rng.normal(0, 1.0, 2), 0.0, rng.normal(0, 0.03))
    prior = PosePrior(error @ ego_from_other, np.diag([1.0, 1.0, 0.03**2]))
    return boxes(seen + noise(6)), Boxes.cat([theirs, boxes(cars(3, 30.0))]), prior, ego_from_other


def evaluate(body: AgentBody | None) -> tuple[int, float]:
    """Return how many poses are found within 1 m and 1 degree, and the median standard deviation of x."""
    found, sigmas = 0, []
    for seed in SEEDS:
        first, second, prior, truth = meet(seed)
        sides = [Landmarks.of_boxes(side).with_body(body) for side in (first, second)]
        estimate = load_corrector("voting")(*sides, prior)
        if estimate.status.has_estimate and estimate.ego_from_other is not None:
            off = truth.inverse() @ estimate.ego_from_other
            found += float(off.translation[:2].norm()) < 1.0 and abs(float(off.yaw)) < math.radians(1.0)
            sigmas.append(math.sqrt(estimate.covariance[0, 0]))
    return found, float(np.median(sigmas))


def test_a_known_offset_restores_the_match_and_an_unknown_one_widens_the_covariance() -> None:
    known, known_sigma = evaluate(BODY)
    wrong, _ = evaluate(AgentBody.standing(0.0, 0.0, BODY.size))
    unknown, unknown_sigma = evaluate(None)
    assert known >= 11 and unknown >= 10 and wrong <= 8
    assert unknown_sigma > 1.3 * known_sigma
