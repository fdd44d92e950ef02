# SPDX-License-Identifier: Apache-2.0
"""The ground that observations saw: views without occluders, in any frame, and its file."""

import numpy as np
import pytest

from manyeyes.datatypes.map_element import DIVIDER, MapElements, Polygons
from manyeyes.maps.elements.observation import MapFrame, Observation
from manyeyes.maps.formats.geoparquet import MapFileError
from manyeyes.maps.formats.reframe import move_points
from manyeyes.maps.fusion.observed_ground import ObservedGround

FRAME = MapFrame(48.0, 11.0)


def observe(x, y, yaw=0.0, hidden=()):
    view = np.array([[0.0, -10.0], [40.0, -10.0], [40.0, 10.0], [0.0, 10.0]])
    pose, covariance = np.array([x, y, yaw]), np.diag([0.1, 0.1, 1e-4])
    return Observation("a", "p", 1, pose, covariance, view, MapElements.empty(), occluders=Polygons.of(hidden))


def test_ground_is_the_union_of_views_without_what_is_hidden():
    lorry = np.array([[10.0, -5.0], [20.0, -5.0], [20.0, 5.0], [10.0, 5.0]])
    ground = ObservedGround.of_observations([observe(0, 0, hidden=[lorry]), observe(0, 30, np.pi / 2)], FRAME)
    assert ground.area_m2 == 2 * 800 - 100
    points = np.array([[5.0, 0.0], [15.5, 0.5], [15.5, 6.5], [39.5, 9.5], [41.0, 0.0], [-9.5, 60.5], [-0.5, 0.0]])
    assert ground.covers(points, FRAME).tolist() == [True, False, True, True, False, True, False]
    # Another agent sees behind the lorry.
    both = ObservedGround.of_observations([observe(0, 0, hidden=[lorry]), observe(5, 0)], FRAME)
    assert both.covers(points[1:2], FRAME).all() and both.area_m2 == 45 * 20


def test_ground_answers_in_another_frame():
    ground, other = ObservedGround.of_observations([observe(0, 0)], FRAME), MapFrame(48.02, 11.05)
    points = np.random.default_rng(0).uniform(-20, 60, (500, 2))
    np.testing.assert_array_equal(ground.covers(move_points(points, FRAME, other), other), ground.covers(points, FRAME))
    assert ground.covers(points, FRAME).any() and not ground.covers(points, other).any()


def test_ground_without_observations_is_what_lies_near_the_lines():
    pytest.importorskip("shapely", reason="the map extra is not installed")
    ground = ObservedGround.around(MapElements.of([[[0.0, 0.0], [50.0, 0.0]]], DIVIDER), FRAME)
    assert ground.is_assumed
    assert ground.covers(np.array([[25.0, 9.0], [25.0, 11.5], [-9.0, 0.0]]), FRAME).tolist() == [True, False, True]
    for empty in (ObservedGround.around(MapElements.empty(), FRAME), ObservedGround.of_observations([], FRAME)):
        assert empty.area_m2 == 0 and not empty.covers(np.zeros((2, 2)), FRAME).any()


def test_ground_is_read_back_and_a_damaged_file_is_named(tmp_path):
    ground = ObservedGround.of_observations([observe(3, 4, 0.3)], FRAME)
    ground.write(tmp_path / "ground.npz")
    read = ObservedGround.read(tmp_path / "ground.npz")
    assert read.frame == FRAME and not read.is_assumed
    np.testing.assert_array_equal(read.runs, ground.runs)
    (tmp_path / "ground.npz").write_bytes((tmp_path / "ground.npz").read_bytes()[:60])
    with pytest.raises(MapFileError, match=r"ground\.npz.*observed ground"):
        ObservedGround.read(tmp_path / "ground.npz")
