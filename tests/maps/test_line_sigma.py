# SPDX-License-Identifier: Apache-2.0
"""The standard deviations of fused lines are those of their lateral errors, on places that nothing is tested on otherwise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.experiment import FleetTrial, run_trial
from manyeyes.maps.fusion.fuse import fuse
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
