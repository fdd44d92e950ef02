# SPDX-License-Identifier: Apache-2.0
"""Streets of varied layout: places of lanes, no overlap, repeatable draws, and scenes in them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.simulator.fleet.landmarks import LandmarkSpec, make_landmark_scene
from manyeyes.simulator.fleet.street_layouts import (
    StreetLayout,
    draw_layout,
    make_street_traffic,
    place_beside_road,
    place_in_lane,
    place_on_road,
)


def test_layouts_and_traffic_are_functions_of_their_seed() -> None:
    first, second = (make_street_traffic(draw_layout(rng), rng) for rng in (np.random.default_rng(4) for _ in range(2)))
    np.testing.assert_array_equal(first.pose, second.pose)
    layouts = [draw_layout(np.random.default_rng(n)) for n in range(60)]
    assert len({layout.lanes for layout in layouts}) == 3 and {layout.num_roads for layout in layouts} == {1, 2}


def test_vehicles_stand_in_lanes_and_bays_and_do_not_overlap() -> None:
    layout = StreetLayout(num_roads=1, lanes=2, lane_m=3.0, row_prob=1.0)
    traffic = make_street_traffic(layout, np.random.default_rng(1))
    assert len(traffic.pose) > 30
    lateral = np.abs(traffic.pose[:, 1])
    lanes = np.array([1.5, 4.5, 7.1])
    assert (np.abs(lateral[:, None] - lanes).min(1) < 1.3).all()
    assert (traffic.speed[lateral > 6.2] == 0).all() and (traffic.speed[lateral < 5.5] > 0).all()
    apart = np.hypot(*(traffic.pose[:, None, :2] - traffic.pose[None, :, :2]).transpose(2, 0, 1))
    assert (apart[~np.eye(len(apart), dtype=bool)] >= 4.0).all()
    # On the right of the road's middle: to the left of the axis drives who comes back.
    moving = traffic.speed > 0
    assert (np.sign(traffic.pose[moving, 1]) == -np.sign(np.cos(traffic.pose[moving, 2]))).all()


def test_a_bent_road_keeps_distances_along_its_middle() -> None:
    pose = place_on_road(StreetLayout(curvature_per_m=0.005), 0, np.linspace(-100, 100, 2001), np.zeros(2001))
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    np.testing.assert_allclose(steps, 0.1, rtol=1e-4)
    np.testing.assert_allclose(np.diff(pose[:, 2]), 0.0005, rtol=1e-9)


def test_agents_stand_in_a_lane_and_beside_the_road() -> None:
    layout, rng = StreetLayout(num_roads=1, lanes=1, lane_m=3.0), np.random.default_rng(2)
    for _ in range(20):
        vehicle, speed = place_in_lane(layout, rng)
        assert abs(abs(vehicle[1]) - 1.5) < 1e-9 and 0 <= speed <= 12
        pole = place_beside_road(layout, rng)
        assert abs(pole[1]) > 3.0 and abs(pole[0]) < 20.0


def test_scenes_in_a_layout_hold_the_common_objects_at_the_true_pose() -> None:
    spec = LandmarkSpec(6, 8, 10, layout=StreetLayout(lanes=2, crossing_rad=1.2))
    scene = make_landmark_scene(spec, 3, 1)
    i, k = scene.common_pairs.T
    assert len(i) == 6
    c, s = math.cos(scene.ego_from_other[2]), math.sin(scene.ego_from_other[2])
    other = scene.other[0].center[k, :2].numpy()
    moved = other @ np.array([[c, s], [-s, c]]) + scene.ego_from_other[:2]
    assert np.hypot(*(moved - scene.ego[0].center[i, :2].numpy()).T).max() < 1.5


def test_nulls_at_two_places_have_two_layouts_and_later_traffic_one() -> None:
    rng = np.random.default_rng(8)
    spec = LandmarkSpec(0, 9, 11, disjoint=True, layout=draw_layout(rng), other_layout=draw_layout(rng))
    assert len(make_landmark_scene(spec, 1, 2).common_pairs) == 0
    later = LandmarkSpec(0, 9, 11, parked_fraction=0.5, layout=draw_layout(rng))
    assert len(make_landmark_scene(later, 1, 2).other[0].center) == 11


def test_impossible_layouts_are_refused() -> None:
    with pytest.raises(ConfigError, match="one or two roads"):
        StreetLayout(num_roads=3)
