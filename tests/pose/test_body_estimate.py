# SPDX-License-Identifier: Apache-2.0
"""A vehicle's place in its own frame, from the boxes in which another agent detects it.

The subject stands at the origin of its frame, its middle 1.5 m ahead. The observer stands at (20, 5), turned by 2 rad; both detect
four cars, the observer the subject too, as its last box.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from manyeyes.datatypes import AgentBody, ConfigError
from manyeyes.pose.body_estimate import BodyConfig, BodyEstimate, append_body, update_body
from manyeyes.pose.landmarks import Landmarks

SUBJECT_FROM_OBSERVER = np.array([20.0, 5.0, 2.0])
CARS = np.array([(12.0, 9.0, 0.3), (-15.0, 4.0, 1.2), (6.0, -18.0, -0.4), (30.0, 12.0, 2.0)])
PAIRS = np.stack((np.arange(4), np.arange(4)), 1)


def landmarks(rows: NDArray[np.float64]) -> Landmarks:
    """Cars at rows (N, 3) of x, y, yaw, with an error of 0.2 m."""
    ones = np.ones(len(rows))
    size = np.tile([4.2, 1.8], (len(rows), 1))
    return Landmarks(
        rows[:, :2], rows[:, 2], size, ones, 0.2 * ones, 0.05 * ones, 0.05 * ones, np.zeros(len(rows), int)
    )


def from_observer(rows: NDArray[np.float64]) -> Landmarks:
    x, y, yaw = SUBJECT_FROM_OBSERVER
    c, s = math.cos(yaw), math.sin(yaw)
    back = np.array([-c * x - s * y, s * x - c * y, -yaw])
    return landmarks(rows).transform(back)


SUBJECT, BODY = landmarks(CARS), np.array([(1.5, 0.1, 0.0)])
OBSERVER = from_observer(np.concatenate((CARS, BODY)))


def test_one_measurement_is_weighted_with_the_assumption_that_the_middle_is_near_the_origin() -> None:
    found = update_body(None, OBSERVER, SUBJECT, PAIRS, 0.0)
    assert found is not None and found.num_measurements == 1 and found.size.tolist() == [4.2, 1.8]
    # Variance of one measurement, along x: 0.04 of the box, 0.08 / 4 of the shift, and of the turn 0.08 m^2 over the summed squared
    # distances of the cars, times the squared lateral distance from their middle.
    middle = CARS[:, :2].mean(0)
    turn = 0.08 / np.square(CARS[:, :2] - middle).sum()
    variance = 0.04 + 0.02 + turn * np.square(BODY[0, 1] - middle[1])
    assert found.xy[0] == pytest.approx(1.5 / (1 + variance), abs=0.005)
    assert found.covariance[0, 0] == pytest.approx(variance / (1 + variance), abs=0.002)


def test_the_estimate_converges_and_repeated_measurements_count_less() -> None:
    slow, fast = None, None
    for n in range(20):
        slow = update_body(slow, OBSERVER, SUBJECT, PAIRS, float(10 * n))
        fast = update_body(fast, OBSERVER, SUBJECT, PAIRS, 0.01 * n)
    assert slow is not None and fast is not None
    np.testing.assert_allclose(slow.xy, BODY[0, :2], atol=0.02)
    assert slow.sigma_m() == pytest.approx(math.hypot(0.1, 0.06), abs=0.02) and fast.sigma_m() > 2 * slow.sigma_m()


def test_the_assumed_place_of_the_body_does_not_confirm_itself() -> None:
    # A fifth pair, of the detected vehicle with the body that the subject appended at its origin, changes nothing.
    pairs = np.concatenate((PAIRS, [[4, 4]]))
    found, expected = (update_body(None, OBSERVER, SUBJECT, rows, 0.0) for rows in (pairs, PAIRS))
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found.xy, expected.xy)


@pytest.mark.parametrize(
    ("observer", "pairs"),
    [
        (OBSERVER, PAIRS[:2]),  # two objects give no check of the pose
        (from_observer(CARS), PAIRS),  # the vehicle is not detected
        (from_observer(np.concatenate((CARS, [(6.0, 0.0, 0.0)]))), PAIRS),  # another car 6 m ahead
        (from_observer(np.concatenate((CARS, [(1.5, 0.0, 1.57)]))), PAIRS),  # a car across
    ],
)
def test_without_a_box_at_the_vehicle_nothing_is_estimated(observer: Landmarks, pairs: NDArray[np.int64]) -> None:
    assert update_body(None, observer, SUBJECT, pairs, 0.0) is None


def test_a_box_that_contradicts_a_certain_estimate_and_an_earlier_one_are_left_out() -> None:
    certain = BodyEstimate(np.array([-1.2, 0.0]), 0.01 * np.eye(2), np.array([4.5, 1.9]), 9, 5.0)
    assert update_body(certain, OBSERVER, SUBJECT, PAIRS, 6.0) is certain
    near = BodyEstimate(np.array([1.4, 0.0]), 0.01 * np.eye(2), np.array([4.5, 1.9]), 9, 5.0)
    assert update_body(near, OBSERVER, SUBJECT, PAIRS, 5.0) is near
    after = update_body(near, OBSERVER, SUBJECT, PAIRS, 6.0)
    assert after is not None and after.num_measurements == 10


def test_a_stated_body_precedes_an_estimated_one() -> None:
    estimate = BodyEstimate(np.array([1.4, 0.2]), 0.04 * np.eye(2), np.array([5.0, 2.0]), 9, 5.0)
    stated = append_body(SUBJECT, AgentBody.standing(0.7, 0.0, (4.5, 1.9, 1.6)), estimate)
    estimated, unknown = append_body(SUBJECT, None, estimate), append_body(SUBJECT, None, None)
    assert [x.xy[-1].tolist() for x in (stated, estimated, unknown)] == [[0.7, 0.0], [1.4, 0.2], [0.0, 0.0]]
    assert [float(x.sigma_xy[-1]) for x in (stated, unknown)] == [0.1, 1.0]
    assert estimated.sigma_xy[-1] == pytest.approx(math.hypot(0.2, 0.1)) and estimated.size[-1].tolist() == [5.0, 2.0]


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigError, match="min_pairs >= 2"):
        BodyConfig(min_pairs=1)
