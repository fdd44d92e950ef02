# SPDX-License-Identifier: Apache-2.0
"""The graph of elements: each relation on a case worked by hand, crossings against shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manyeyes.datatypes import ConfigError, ShapeError
from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.maps.fusion.graph import GraphConfig, build_element_graph


def line(y: float, x0: float = 0.0, x1: float = 40.0) -> list[list[float]]:
    return [[x0, y], [(x0 + x1) / 2, y], [x1, y]]


def test_lines_on_each_other_overlap_over_an_interval_with_an_offset() -> None:
    graph = build_element_graph(MapElements.of([line(0.0), line(0.5, 25, 60)[::-1]], DIVIDER)).select_relation(
        "overlap"
    )
    assert graph.edge.tolist() == [[0, 1]]
    assert graph.interval[0] == pytest.approx([25, 40, 20, 35], abs=1e-9)
    assert graph.lateral[0] == pytest.approx(0.5) and graph.spread[0] == pytest.approx(0.0, abs=1e-9)


def test_the_spread_is_the_median_deviation_of_the_offset() -> None:
    slanted = [[0.0, -0.5], [40.0, 0.5]]
    graph = build_element_graph(MapElements.of([line(0.0), slanted], DIVIDER)).select_relation("overlap")
    assert graph.lateral[0] == pytest.approx(0.0, abs=1e-3)
    # 41 offsets from -0.5 to 0.5 in equal steps: half of them are within a quarter.
    assert graph.spread[0] == pytest.approx(0.25, abs=1e-3)


def test_lines_a_lane_apart_are_parallel_and_the_left_is_positive() -> None:
    graph = build_element_graph(MapElements.of([line(0.0), line(3.5), line(-3.5, 10, 30), line(9.9)], [0, 1, 0, 0]))
    assert len(graph.select_relation("overlap")) == 0
    found = {
        tuple(e): round(float(v), 6)
        for e, v in zip(graph.select_relation("parallel").edge.tolist(), graph.select_relation("parallel").lateral)
    }
    assert found == {(0, 1): 3.5, (0, 2): -3.5}


def test_kinds_do_not_overlap_and_short_common_parts_do_not_count() -> None:
    graph = build_element_graph(MapElements.of([line(0.0), line(0.2), line(0.1, 37, 70)], [DIVIDER, BOUNDARY, DIVIDER]))
    assert len(graph.select_relation("overlap")) == 0


def test_an_end_ahead_of_an_end_continues_it() -> None:
    lines = [line(0.0), line(0.3, 45, 70), line(0.0, 49, 70), line(1.5, 43, 70), [[44.0, 0.0], [60.0, 8.0]]]
    graph = build_element_graph(MapElements.of(lines, DIVIDER)).select_relation("continues")
    # 5 m ahead and 0.3 m aside; not: 9 m ahead, 1.5 m aside, 27 degrees off.
    assert graph.edge[graph.edge[:, 0] == 0].tolist() == [[0, 1]]
    assert graph.gap[0] == pytest.approx(math.hypot(5, 0.3)) and graph.ends[0].tolist() == [1, 0]
    turned = build_element_graph(MapElements.of([line(0.0)[::-1], line(0.3, 45, 70)[::-1]], DIVIDER)).select_relation(
        "continues"
    )
    assert turned.ends.tolist() == [[0, 1]]


def test_crossing_lines_are_found_as_by_shapely() -> None:
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(4)
    lines = [rng.uniform(-20, 20, 2) + np.cumsum(rng.normal(0, 6, (4, 2)), 0) for _ in range(40)]
    graph = build_element_graph(
        MapElements.of(lines, DIVIDER), config=GraphConfig(min_crossing_angle_rad=0.0)
    ).select_relation("crosses")
    strings = [shapely.LineString(points) for points in lines]
    want = [[i, j] for i in range(40) for j in range(i + 1, 40) if strings[i].intersects(strings[j])]
    assert graph.edge.tolist() == want and len(want) > 20
    for (i, j), (s, _, t, _) in zip(graph.edge.tolist(), graph.interval):
        here, there = strings[i].interpolate(s), strings[j].interpolate(t)
        assert here.distance(there) < 1e-9


def test_line_crossing_ring_reports_angle() -> None:
    square = [[10.0, -3.0], [14.0, -3.0], [14.0, 3.0], [10.0, 3.0]]
    graph = build_element_graph(MapElements.of([line(0.0), square], [DIVIDER, CROSSING]))
    (edge,) = graph.select_relation("crosses").edge.tolist()
    assert edge == [0, 1] and graph.select_relation("crosses").turn[0] == pytest.approx(math.pi / 2)
    assert len(graph.select_relation("overlap")) == 0


def test_rings_on_each_other_overlap() -> None:
    square = np.array([[10.0, -3.0], [14.0, -3.0], [14.0, 3.0], [10.0, 3.0]])
    graph = build_element_graph(MapElements.of([square, square + 0.2], CROSSING)).select_relation("overlap")
    assert graph.edge.tolist() == [[0, 1]]


def test_separate_elements_of_one_observation_cannot_link() -> None:
    lines = [line(0.05), line(0.0), line(1.1), line(0.1), line(0.3, 0, 20)]
    graph = build_element_graph(MapElements.of(lines, DIVIDER), [-1, 0, 0, 1, 1])
    assert graph.select_relation("same_observation").edge.tolist() == [[1, 2], [3, 4]]
    assert graph.edge[graph.cannot_link].tolist() == [[1, 2]]


def test_no_elements_no_edges_and_an_unknown_relation_is_named() -> None:
    graph = build_element_graph(MapElements.empty())
    assert len(graph) == 0
    with pytest.raises(ConfigError, match="overlap, continues, parallel"):
        graph.select_relation("beside")
    with pytest.raises(ShapeError, match="two points"):
        build_element_graph(MapElements.of([[[0, 0]]], 0))
