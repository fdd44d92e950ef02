# SPDX-License-Identifier: Apache-2.0
"""The standard deviations of fused lines are those of their lateral errors, on places that nothing is tested on otherwise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.fusion.fuse import fuse
from manyeyes.maps.fusion.pose_optimization import bound_covariance, solve_poses
from manyeyes.maps.fusion.pose_solution import REJECTED_WEIGHT
from manyeyes.simulator.fleet.config import CROWDS

MAX_LATERAL_M = 1.2
"""Lines farther from every true one are false."""


def find_lateral_errors(points: np.ndarray, truth: MapElements, kind: int) -> np.ndarray:
    """Lateral distance (P,) to the nearest true line of a kind, infinite beyond the ends of all."""
    nearest = np.full(len(points), np.inf)
    for row in np.flatnonzero(truth.kind == kind).tolist():
        line = truth.polyline(row)
        for begin, end in pairwise(line):
            step = end - begin
            length = np.hypot(*step)
            along = (points - begin) @ step / length
            aside = np.abs((points - begin) @ (-step[1], step[0])) / length
            nearest = np.where((along >= 0) & (along <= length), np.minimum(nearest, aside), nearest)
    return nearest


@pytest.mark.slow
@pytest.mark.parametrize("count", [20, 60])
def test_standard_deviations_are_those_of_the_errors(count: int) -> None:
    error, sigma = [], []
    for place in ("cross", "generated-3"):
        experiment = run_trial(FleetTrial(place, count, 3000, fleet_config=CROWDS["local"]))
        found = fuse(experiment.observations, frame=experiment.place.frame).select_published().elements
        for kind in (DIVIDER, BOUNDARY):
            for row in np.flatnonzero(found.kind == kind).tolist():
                part = slice(*found.offsets[row : row + 2].tolist())
                error.append(find_lateral_errors(found.points[part], experiment.truth, kind))
                sigma.append(found.sigma[part])
    errors, sigmas = np.concatenate(error), np.concatenate(sigma)
    is_true = errors < MAX_LATERAL_M
    errors, sigmas = errors[is_true], sigmas[is_true]
    assert len(errors) > 500
    assert 0.7 < np.sqrt(np.mean(errors**2)) / np.sqrt(np.mean(sigmas**2)) < 1.3
    assert np.mean(errors < 1.96 * sigmas) > 0.9
    surest = sigmas < np.quantile(sigmas, 0.3)
    assert errors[surest].mean() < 0.8 * errors[~surest].mean()


def observe_straight_road(agent: str, k: int, x: float, error_m: float, has_boundary: bool = False) -> Observation:
    """Four parallel lines along x from a prior pose that is wrong by error_m in y; has_boundary: and one along y at x = 82 m."""
    lines = [np.array([[-25.0, y], [25.0, y]]) for y in (-5.25, -1.75, 1.75, 5.25)]
    kinds = [DIVIDER] * len(lines)
    if has_boundary:
        lines.append(np.array([[82.0 - x, 8.0], [82.0 - x, 14.0]]))
        kinds.append(BOUNDARY)
    view = np.array([[-30.0, -15.0], [30.0, -15.0], [30.0, 15.0], [-30.0, 15.0]])
    pose, covariance = np.array([x, error_m, 0.0]), np.diag((0.16, 0.16, 1e-5))
    return Observation(agent, "pass", k * 10**9, pose, covariance, view, MapElements.of(lines, kinds))


def test_a_direction_that_no_line_constrains_is_no_kilometre_of_error() -> None:
    # The agent "off" is rejected, so its priors count no more, and the parallel lines leave its poses free along the road.
    observations = [observe_straight_road(f"a{a}", 10 * a + k, 20.0 * k, 0.0) for a in range(3) for k in range(8)]
    observations += [observe_straight_road("off", 100 + k, 20.0 * k, 1.5, k in (3, 4, 5)) for k in range(8)]
    solution = solve_poses(observations)
    is_off = np.array([agent == "off" for agent in solution.agents])
    assert (solution.agent_weight[is_off] == REJECTED_WEIGHT).all() and (solution.agent_weight[~is_off] == 1.0).all()
    # Its prior poses are wrong by 1.5 m, 3.75 standard deviations of .4 m.
    deviations = np.sqrt((solution.covariance + solution.common_covariance)[:, [0, 1], [0, 1]])
    assert deviations.max() < 1.6 and deviations[~is_off].max() < 0.45
    elements = fuse(observations, frame=MapFrame(48.137, 11.575)).elements
    across = np.flatnonzero(elements.kind == BOUNDARY)
    assert len(across) == 1 and elements.lengths()[across[0]] > 5.0
    sigma = elements.sigma[elements.offsets[across[0]] : elements.offsets[across[0] + 1]]
    assert sigma.min() > 0.4 and sigma.max() < 1.6


def test_the_bound_of_a_covariance_is_of_each_direction_and_changes_no_other() -> None:
    generator = np.random.default_rng(0)
    root = generator.normal(size=(40, 3, 3))
    prior = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    correction = generator.normal(size=(40, 3))
    within = prior * generator.uniform(0.1, 8.9, (40, 1, 1))
    assert np.array_equal(bound_covariance(within, prior, correction, 3.0), within)
    # A direction of a million prior variances; in the metric of the prior, all others stay.
    axis = np.linalg.cholesky(prior) @ np.array([0.6, 0.0, 0.8])
    free = within + 1e6 * axis[:, :, None] * axis[:, None, :]
    bounded = bound_covariance(free, prior, correction, 3.0)
    sigmas = np.einsum("oi,oij,oj->o", correction, np.linalg.inv(prior), correction)
    largest = np.linalg.eigvals(np.linalg.inv(prior) @ bounded).real.max(1)
    assert np.allclose(largest, np.maximum(9.0, sigmas)) and (sigmas > 9.0).any() and (sigmas < 9.0).any()
    across = np.linalg.inv(np.linalg.cholesky(prior)).transpose(0, 2, 1) @ np.array([0.0, 1.0, 0.0])
    assert np.allclose(*(np.einsum("oi,oij,oj->o", across, matrix, across) for matrix in (bounded, within)), rtol=1e-4)
