# SPDX-License-Identifier: Apache-2.0
"""The measured errors of boxes: per axis, heavy-tailed, autocorrelated; clutter, bodies and later traffic of the scenes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.fleet.landmark_errors import (
    REAL_BOXES,
    BoxNoise,
    MeasuredBoxErrors,
    draw_latent,
    make_errors,
    step_latent,
)
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, SensorClutter, make_landmark_scene

EXACT = BoxNoise(1e-9, 1e-9, 0.0, 1e-9)
EXACT_CLUTTER = SensorClutter(20, 0.5, sigma_m=0.0, sigma_yaw_rad=0.0)


def to_ego(xy: np.ndarray, pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return xy @ np.array([[c, s], [-s, c]]) + pose[:2]


def nearest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1)).min(1)


def test_errors_have_the_stated_axes_and_tails() -> None:
    errors = make_errors(REAL_BOXES, draw_latent(200_000, keyed_generator(0)))
    # The median absolute value of a contaminated Gaussian is a little above that of its core, 0.674 sigma.
    core = np.median(np.abs(errors.xy), 0) / 0.674
    np.testing.assert_allclose(core, [0.32, 0.213], rtol=0.03)
    assert np.mean(np.abs(errors.xy[:, 1]) > 0.6) == pytest.approx(0.92 * 0.0027 + 0.08 * 0.317, rel=0.1)
    near_pi = np.abs(np.abs(errors.yaw) - math.pi) < 1.0
    assert near_pi.mean() == pytest.approx(0.06, abs=0.005)
    wide = np.abs(np.remainder(errors.yaw + math.pi / 2, math.pi) - math.pi / 2) > math.radians(9.0)
    assert wide.mean() == pytest.approx(0.9 * 0.0027 + 0.1 * 0.453, rel=0.1)


def test_errors_of_an_object_are_autocorrelated() -> None:
    rng = keyed_generator(1)
    for rho in (0.0, 0.5, 0.9):
        now = draw_latent(50_000, rng)
        then = step_latent(now, rho, rng)
        assert np.corrcoef(now[:, 0], then[:, 0])[0, 1] == pytest.approx(rho, abs=0.02)
        assert then.std() == pytest.approx(1.0, abs=0.01)


def test_clutter_stays_with_the_sensor() -> None:
    scene = make_landmark_scene(LandmarkSpec(3, 2, 2, EXACT, clutter=EXACT_CLUTTER), 0, 0)
    ego, other = (b[0].center[:, :2].numpy() for b in (scene.ego, scene.other))
    assert (len(ego), len(other)) == (25, 25)
    np.testing.assert_allclose(ego[5:15], other[5:15], atol=1e-9)
    assert nearest(ego[15:], other[15:]).min() > 1e-3


def test_vehicles_observe_each_other_where_their_bodies_are() -> None:
    spec = LandmarkSpec(2, 3, 3, EXACT, placement="near", body_offset_m=1.5)
    scene = make_landmark_scene(spec, 0, 1)
    assert scene.body is not None and scene.body.center[0] == 1.5
    ego, other = (b[0].center[:, :2].numpy() for b in (scene.ego, scene.other))
    body = np.array([[1.5, 0.0]])
    np.testing.assert_allclose(nearest(to_ego(body, scene.ego_from_other), ego), 0, atol=1e-6)
    np.testing.assert_allclose(nearest(body, to_ego(other, scene.ego_from_other)), 0, atol=1e-6)
    with pytest.raises(ConfigError, match="two vehicles"):
        LandmarkSpec(2, body_offset_m=1.0)


@pytest.mark.parametrize(
    ("placement", "low", "high"), [("beside", 2.0, 3.7), ("ahead", 6.2, 6.4), ("near", 10.0, 40.0)]
)
def test_a_second_vehicle_is_where_it_is_placed(placement: str, low: float, high: float) -> None:
    for n in range(5):
        pose = make_landmark_scene(LandmarkSpec(2, 3, 3, EXACT, placement=placement), 0, n).ego_from_other
        assert low <= np.hypot(*pose[:2]) <= high


def test_later_traffic_shares_parked_vehicles_alone() -> None:
    counts = {}
    for fraction in (0.0, 0.9):
        spec = LandmarkSpec(0, 400, 400, EXACT, parked_fraction=fraction)
        shared = 0
        for n in range(4):
            scene = make_landmark_scene(spec, 2, n)
            assert len(scene.common_pairs) == 0
            ego, other = (b[0].center[:, :2].numpy() for b in (scene.ego, scene.other))
            shared += (nearest(ego, to_ego(other, scene.ego_from_other)) < 1e-4).sum()
        counts[fraction] = shared
    assert counts[0.0] == 0 and counts[0.9] > 20


def test_extras_do_not_change_the_scenes_without_them() -> None:
    plain, cluttered = (
        make_landmark_scene(LandmarkSpec(5, clutter=clutter), 3, 2) for clutter in (SensorClutter(), EXACT_CLUTTER)
    )
    assert (plain.ego[0].center == cluttered.ego[0].center[: len(plain.ego[0])]).all()
    with pytest.raises(ConfigError, match="autocorrelation"):
        MeasuredBoxErrors(autocorrelation=1.0)
