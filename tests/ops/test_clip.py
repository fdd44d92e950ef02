# SPDX-License-Identifier: Apache-2.0
"""Cutting to a convex polygon: cases drawn by hand, and shapely as the slow twin."""

import numpy as np
import pytest

from manyeyes.ops.clip import clip_line, clip_ring, ring_area

BOX = np.array([[0.0, -5.0], [10.0, -5.0], [10.0, 5.0], [0.0, 5.0]])


def parts(line, polygon=BOX):
    return [part.tolist() for part in clip_line(np.array(line, float), polygon)]


def test_a_line_is_cut_at_the_edge_and_keeps_its_points_inside():
    assert parts([(-5, 0), (5, 0), (5, 2), (20, 2)]) == [[[0, 0], [5, 0], [5, 2], [10, 2]]]
    assert parts([(2, 0), (2, 1), (3, 4)]) == [[[2, 0], [2, 1], [3, 4]]], "inside: as it is"
    assert parts([(-5, 9), (15, 9)]) == [] and parts([(-5, -4), (-5, 4)]) == []


def test_a_line_that_leaves_and_reenters_becomes_two():
    assert parts([(2, 0), (2, 9), (7, 9), (7, 0)]) == [[[2, 0], [2, 5]], [[7, 5], [7, 0]]]
    assert parts([(-5, 0), (15, 0), (15, 2), (-5, 2)]) == [[[0, 0], [10, 0]], [[10, 2], [0, 2]]]


def test_a_line_along_an_edge_is_inside_and_one_that_touches_a_corner_is_not():
    assert parts([(-5, 5), (15, 5)]) == [[[0, 5], [10, 5]]]
    assert parts([(-5, 0), (5, 10)]) == [] and parts([(3, 3)]) == []


def test_a_ring_is_cut_as_a_ring():
    ring = np.array([[8.0, 0.0], [12.0, 0.0], [12.0, 2.0], [8.0, 2.0]])
    got = clip_ring(ring, BOX)
    assert ring_area(got) == pytest.approx(4.0) and got[:, 0].max() == 10.0
    assert clip_ring(ring[::-1], BOX).shape == got.shape and ring_area(clip_ring(ring[::-1], BOX)) == pytest.approx(
        -4.0
    )
    np.testing.assert_array_equal(clip_ring(ring - (5, 0), BOX), ring - (5, 0))
    assert clip_ring(ring + (20, 0), BOX).shape == (0, 2) and ring_area(np.zeros((0, 2))) == 0.0


def test_shapely_agrees():
    shapely = pytest.importorskip("shapely", reason="the 'map' extra is not installed")
    rng = np.random.default_rng(2)
    for _ in range(60):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 6))
        polygon = rng.uniform(-3, 3, 2) + 8.0 * np.stack((np.cos(angle), np.sin(angle)), 1)
        if np.diff(angle, append=angle[0] + 2 * np.pi).max() > 3.0:
            continue
        line = np.cumsum(rng.normal(0, 4, (12, 2)), 0)
        inside = shapely.intersection(shapely.linestrings(line), shapely.polygons(polygon))
        length = sum(float(np.hypot(*np.diff(part, axis=0).T).sum()) for part in clip_line(line, polygon))
        assert length == pytest.approx(shapely.length(inside), abs=1e-9)
        turn = np.sort(rng.uniform(0, 2 * np.pi, 9))
        ring = rng.uniform(1, 9, (9, 1)) * np.stack((np.cos(turn), np.sin(turn)), 1) + rng.uniform(-6, 6, 2)
        area = shapely.area(shapely.intersection(shapely.polygons(ring), shapely.polygons(polygon)))
        if shapely.polygons(ring).is_valid:
            assert ring_area(clip_ring(ring, polygon)) == pytest.approx(area, abs=1e-9)
