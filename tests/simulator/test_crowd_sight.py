# SPDX-License-Identifier: Apache-2.0
"""The compiled observation model against slow references in NumPy and shapely."""

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, DOUBLE, NO_STYLE
from manyeyes.simulator.fleet.config import CROWDS
from manyeyes.simulator.fleet.observation_model import (
    CHUNK,
    STATION_M,
    MapModelNoise,
    _clip_ring,
    _emit_ring,
    _hidden,
    _max_range,
    _resample,
    build_map_index,
    hash_normal,
    hash_uniform,
)
from manyeyes.simulator.fleet.place import load_place
from manyeyes.simulator.fleet.routes import Routes, sample_poses
from manyeyes.simulator.fleet.simulate import _role, simulate_crowd

shapely = pytest.importorskip("shapely")
VIEW = MapModelNoise(-30.0, 30.0, -15.0, 15.0, *([0.0] * 9))
KEY = np.uint64(12345)


def draws(count=2000, **at):
    where = {"element": 3, "run": 0, "purpose": 0} | at
    name = next(k for k in ("element", "run", "purpose") if k not in at)
    return np.array([hash_uniform(KEY, *({**where, name: i}.values())) for i in range(count)])


def test_draws_are_uniform_and_unlike_each_other_along_every_count():
    for fixed in ({"run": 0, "purpose": 0}, {"element": 3, "purpose": 0}, {"element": 3, "run": 0}):
        u = draws(**fixed)
        assert 0.0 < u.min() < 0.01 and 0.99 < u.max() < 1.0
        assert np.histogram(u, 10, (0, 1))[0] == pytest.approx(200, abs=60)
        assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 0.08
    assert hash_uniform(KEY, 1, 2, 3) == hash_uniform(KEY, 1, 2, 3) != hash_uniform(np.uint64(12346), 1, 2, 3)
    assert len({hash_uniform(KEY, *p) for p in ((1, 2, 3), (3, 2, 1), (2, 1, 3), (1, 3, 2))}) == 4


def test_normal_draws_have_mean_zero_and_variance_one():
    n = np.array([hash_normal(KEY, i, 0, 5) for i in range(4000)])
    assert abs(n.mean()) < 0.06 and n.std() == pytest.approx(1.0, abs=0.05)
    assert np.mean(np.abs(n) < 1.0) == pytest.approx(0.683, abs=0.03)


@pytest.mark.parametrize("closed", [False, True])
def test_resampling_is_equal_arc_length(closed):
    line = np.random.default_rng(2).normal(size=(9, 2)).cumsum(0)
    out = np.empty((20, 2))
    total = _resample(line, 20, closed, out)
    whole = np.concatenate((line, line[:1])) if closed else line
    station = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(whole, axis=0), axis=1))))
    s = np.linspace(0.0, station[-1], 20, endpoint=not closed)
    np.testing.assert_allclose(out, np.stack([np.interp(s, station, whole[:, k]) for k in (0, 1)], 1), atol=1e-12)
    assert total == pytest.approx(station[-1])


def test_a_ring_is_cut_to_the_view_as_shapely_does():
    view = shapely.box(-30, -15, 30, 15)
    generator = np.random.default_rng(3)
    partly = 0
    for _ in range(200):
        angle = np.sort(generator.uniform(0, 2 * np.pi, 6))
        ring = generator.uniform((-40, -25), (40, 25)) + np.stack((8 * np.cos(angle), 8 * np.sin(angle)), 1)
        cut, area = _clip_ring(ring, VIEW)
        expected = shapely.Polygon(ring).intersection(view).area
        assert area == pytest.approx(expected, abs=1e-9)
        partly += 0.01 < expected < shapely.Polygon(ring).area - 0.01
        if area > 0.01:
            assert shapely.Polygon(cut).intersection(view).area == pytest.approx(expected, abs=1e-9)
    assert partly > 30


def test_an_exact_rectangle_is_observed_unchanged():
    """Points of one side lie on one line: they touch, and nothing crosses."""
    corners = np.array([[5.0, -2.0], [9.0, -2.0], [9.0, 2.0], [5.0, 2.0]])
    out = np.empty((20, 2))
    assert _emit_ring(corners, VIEW, KEY, 3, 0, out) == pytest.approx(7.0)
    ring = shapely.Polygon(out)
    assert ring.is_valid and ring.area == pytest.approx(16.0, abs=1.0)


def test_points_behind_a_vehicle_are_occluded():
    quads = np.array([[[5, 2], [20, 8], [20, 12], [4, 4]], [[-5, -2], [-20, -9], [-20, -12], [-5, -4]]], np.float64)
    ground = shapely.union_all([shapely.Polygon(q) for q in quads])
    assert all(shapely.is_ccw(shapely.LinearRing(q)) for q in quads)
    points = np.random.default_rng(5).uniform(-22, 22, (3000, 2))
    expected = shapely.contains(ground, shapely.points(points))
    assert 100 < expected.sum() < 600
    np.testing.assert_array_equal([_hidden(x, y, quads) for x, y in points], expected)
    assert not _hidden(0.0, 0.0, np.zeros((0, 4, 2)))


def test_scenery_covers_every_line_with_chunks_and_keeps_rings():
    line = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 50.0]])
    ring = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    kinds, styles = np.array([DIVIDER, CROSSING, BOUNDARY]), np.array([DOUBLE, NO_STYLE, NO_STYLE])
    scene = build_map_index([line, ring, line + 100], kinds, styles, np.array([4, 8, 9]))
    counts = np.diff(scene.first)
    assert counts.tolist() == [161, 3, 161]
    np.testing.assert_array_equal(scene.points[scene.first[1] : scene.first[2]], ring)
    assert np.diff(scene.of_element).tolist() == [-(-161 // CHUNK), 1, -(-161 // CHUNK)]
    step = np.linalg.norm(np.diff(scene.points[:161], axis=0), axis=1)
    assert step.max() <= STATION_M + 1e-9
    for c in range(len(scene.chunk_radius)):
        part = scene.points[scene.chunk_first[c] : scene.chunk_first[c + 1]]
        assert np.linalg.norm(part - scene.chunk_center[c], axis=1).max() <= scene.chunk_radius[c] + 1e-12


def test_a_walk_follows_the_lanes_and_ends_with_them():
    lanes = [np.array([[0, 0], [10, 0]]), np.array([[10, 0], [20, 0]]), np.array([[10, 0], [10, 9]])]
    routes = Routes.of([lane.astype(float) for lane in lanes], [(0, 1), (0, 2)])
    assert routes.walk(0, 4.0, 100.0, lambda step, count: 1).tolist() == [[4, 0], [10, 0], [10, 9]]
    assert routes.walk(0, 0.0, 5.0, lambda step, count: 1).tolist() == [[0, 0], [10, 0]]
    np.testing.assert_allclose(routes.lengths, [10, 10, 9])
    pose = sample_poses(routes.walk(0, 0.0, 100.0, lambda step, count: 0), np.array([0.0, 5.0, 20.0]))
    np.testing.assert_allclose(pose, [[0, 0, 0], [5, 0, 0], [20, 0, 0]], atol=1e-9)
    inside = routes.within(np.array([5.0, -1.0]), np.array([12.0, 1.0]))
    assert len(inside) == 3 and inside.successor.tolist() == [1, 2]
    assert len(routes.within(np.array([15.0, -1.0]), np.array([25.0, 1.0]))) == 1


def test_a_larger_malicious_fraction_holds_the_smaller():
    import dataclasses

    offsets = np.array([0.1, 0.5, 0.9])
    few, many = (dataclasses.replace(CROWDS["local"], malicious_fraction=s) for s in (0.1, 0.3))
    malicious = [[_role(agent, config, offsets) == 2 for agent in range(200)] for config in (few, many)]
    assert np.mean(malicious, axis=1) == pytest.approx([0.1, 0.3], abs=0.01)
    assert not (np.array(malicious[0]) & ~np.array(malicious[1])).any()


def test_recorded_drives_are_driven_where_a_place_has_them():
    import dataclasses

    where = load_place("cross")
    log = np.column_stack((np.linspace(-80, 80, 321), np.full(321, -1.75), np.zeros(321)))
    crowd = simulate_crowd(
        dataclasses.replace(where, logs=(log,)), 30, dataclasses.replace(CROWDS["perfect"], recorded_drive_fraction=1.0)
    )
    assert np.abs(crowd.true_poses[:, 1] + 1.75).max() < 1.5
    assert np.abs(crowd.true_poses[:, 2]).max() < 0.1
    assert np.ptp(crowd.true_poses[:, 0]) > 60


@pytest.mark.parametrize("limits", [(-10.0, 30.0, -5.0, 15.0), (-30.0, 10.0, -15.0, 5.0)])
def test_the_range_of_an_asymmetric_view_is_that_of_its_far_corner(limits: tuple[float, ...]) -> None:
    corner = np.array([max(limits[:2], key=abs), max(limits[2:], key=abs)])
    assert _max_range(MapModelNoise(*limits, *([0.0] * 9))) == pytest.approx(np.hypot(*corner))
