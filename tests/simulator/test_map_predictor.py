# SPDX-License-Identifier: Apache-2.0
"""The true map as a model would draw it: exact without errors, keyed by the look, and never beyond its window."""

from dataclasses import replace

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.simulator.fleet.config import crowd_config
from manyeyes.simulator.fleet.map_predictor import SimulatedMapPredictor

AHEAD = (0.0, -15.0, 30.0, 15.0)
RING = [[20.0, -5.0], [24.0, -5.0], [24.0, 5.0], [20.0, 5.0]]
TRUTH = MapElements.of(
    [[[-100.0, 0.0], [100.0, 0.0]], [[-100.0, 6.0], [100.0, 6.0]], RING], [DIVIDER, BOUNDARY, CROSSING]
).transform(50.0, 20.0, 0.5)
POSE = np.array([50.0, 20.0, 0.5])


def test_without_errors_the_prediction_is_the_ground_truth():
    # A little noise: the crowd's test for rings that cross themselves takes edges on one line for ones that meet.
    predicted = SimulatedMapPredictor(TRUTH, replace(crowd_config("perfect"), point_sigma_m=0.002)).predict(
        POSE, AHEAD, "a"
    )
    assert predicted.elements.kind.tolist() == [DIVIDER, BOUNDARY, CROSSING]
    for row, y in ((0, 0.0), (1, 6.0)):
        line = predicted.elements.polyline(row)
        np.testing.assert_allclose(line[:, 1], y, atol=0.02)
        assert line[0, 0] == pytest.approx(0.0, abs=0.51) and line[-1, 0] == pytest.approx(30.0, abs=0.51)
    np.testing.assert_allclose(predicted.elements.polyline(2).min(0), [20, -5], atol=0.05)
    np.testing.assert_allclose(predicted.view, [[0, -15], [30, -15], [30, 15], [0, 15]])


def test_errors_depend_on_the_key_and_the_seed_alone():
    def predict(predictor, *noise_key, pose=POSE):
        return predictor.predict(pose, AHEAD, *noise_key).elements

    config = replace(crowd_config("local"), miss_rate=0.0)
    one, again, other = (
        SimulatedMapPredictor(TRUTH, config),
        SimulatedMapPredictor(TRUTH, config),
        SimulatedMapPredictor(TRUTH, config, seed=1),
    )
    first = predict(one, "car", 5)
    predict(one, "van", 7)
    np.testing.assert_array_equal(predict(one, "car", 5).points, first.points)
    np.testing.assert_array_equal(predict(again, "car", 5).points, first.points)
    for elements in (predict(one, "car", 6), predict(other, "car", 5)):
        assert elements.points.shape != first.points.shape or not np.allclose(elements.points, first.points)


def test_an_empty_map_gives_no_elements():
    assert len(SimulatedMapPredictor(MapElements.empty(), crowd_config("local")).predict(POSE, AHEAD).elements) == 0
