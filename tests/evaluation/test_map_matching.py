# SPDX-License-Identifier: Apache-2.0
"""Chamfer distances and matching against loops of a few obvious lines, scipy and shapely, and cases worked by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.maps.matching import (
    MATCHING_PROTOCOLS,
    Lines,
    compute_all_point_ap,
    compute_chamfer,
    get_matching_protocol,
    make_lines,
    match_lines,
    rank_lines,
    resample_lines,
)


def straight(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y1]], dtype=np.float64)


def wiggle(draw: np.random.Generator, n: int) -> list[np.ndarray]:
    return [draw.uniform(-15, 15, 2) + draw.normal(0, 3, (draw.integers(2, 8), 2)).cumsum(0) for _ in range(n)]


def slow_resample(line: np.ndarray, n: int) -> np.ndarray:
    along = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    at = np.linspace(0, along[-1], n)
    return np.stack((np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])), 1)


def slow_chamfer(a: np.ndarray, b: np.ndarray, name: str) -> float:
    """The slow twin: scipy for samples, shapely for lines."""
    from scipy.spatial.distance import cdist
    from shapely import LineString, Point

    if name == "exact":
        n = [max(2, math.ceil(LineString(x).length / 0.5 - 1e-9) + 1) for x in (a, b)]
        there = np.mean([LineString(b).distance(Point(p)) for p in slow_resample(a, n[0])])
        back = np.mean([LineString(a).distance(Point(p)) for p in slow_resample(b, n[1])])
        return 0.5 * float(there + back)
    n = {"maptr": 100, "streammapnet": 200}[name]
    a, b = slow_resample(a, n), slow_resample(b, n)
    if name == "maptr":
        grown = [LineString(x).buffer(2.0, cap_style="flat", join_style="mitre") for x in (a, b)]
        if not grown[0].intersects(grown[1]):
            return math.inf
    table = cdist(a, b)
    return 0.5 * float(table.min(1).mean() + table.min(0).mean())


@pytest.mark.parametrize("name", MATCHING_PROTOCOLS)
def test_every_protocol_measures_what_its_slow_twin_measures(name: str) -> None:
    draw = np.random.default_rng(3)
    mine, theirs = wiggle(draw, 6), wiggle(draw, 5)
    got = compute_chamfer(make_lines(mine), make_lines(theirs), MATCHING_PROTOCOLS[name], 1e9)
    want = [[slow_chamfer(a, b, name) for b in theirs] for a in mine]
    np.testing.assert_allclose(got, want, atol=1e-9)
    assert np.isfinite(got).any() and (name != "maptr" or np.isinf(got).any())


@given(seed=st.integers(0, 10**6))
def test_max_distance_excludes_only_what_is_farther(seed: int) -> None:
    draw = np.random.default_rng(seed)
    mine, theirs = make_lines(wiggle(draw, 4)), make_lines(wiggle(draw, 4))
    whole, near = (compute_chamfer(mine, theirs, MATCHING_PROTOCOLS["exact"], reach) for reach in (1e9, 2.0))
    assert (whole[np.isinf(near)] > 2.0).all()
    np.testing.assert_array_equal(near[np.isfinite(near)], whole[np.isfinite(near)])


def test_the_same_long_line_cut_a_little_shorter_has_a_floor_in_maptr_and_none_in_exact() -> None:
    """300 m, samples 3 m apart: an end shift of half a spacing puts every sample between two others."""
    truth, mine = make_lines([straight(0, 0, 300, 0)]), make_lines([straight(1.5, 0, 298.5, 0)])
    assert compute_chamfer(mine, truth, MATCHING_PROTOCOLS["maptr"], 9.0)[0, 0] > 0.5
    assert compute_chamfer(mine, truth, MATCHING_PROTOCOLS["exact"], 9.0)[0, 0] == pytest.approx(
        0.5 * (2 * 4 * 0.75 / 601), abs=2e-3
    )


def test_a_line_beside_another_is_as_far_as_it_lies_beside() -> None:
    table = compute_chamfer(
        make_lines([straight(0, 0.4, 20, 0.4)]), make_lines([straight(0, 0, 20, 0)]), MATCHING_PROTOCOLS["exact"], 9.0
    )
    assert table[0, 0] == pytest.approx(0.4, abs=1e-12)


def test_samples_keep_the_ends_and_are_never_farther_apart_than_the_spacing() -> None:
    lines = make_lines([np.array([[0, 0], [0, 0], [3.3, 0], [3.3, 1.0]]), straight(5, 5, 5, 5.2)])
    got = resample_lines(lines, MATCHING_PROTOCOLS["exact"])
    assert np.diff(got.offsets).tolist() == [10, 2]
    assert got.line(0)[[0, -1]].tolist() == [[0, 0], [3.3, 1.0]] and got.line(1).tolist() == [[5, 5], [5, 5.2]]
    assert np.hypot(*np.diff(got.line(0), axis=0).T).max() <= 0.5


def test_a_prediction_is_compared_with_its_nearest_truth_only() -> None:
    """The second is nearest to a truth that is taken; the other truth within its threshold is no second choice."""
    table = np.array([[0.1, 0.9], [0.2, 0.3], [5.0, 0.4]])
    assert match_lines(table, np.array([0, 1, 2]), 0.5).tolist() == [0, -1, 1]
    assert match_lines(table, np.array([1, 0, 2]), 0.5).tolist() == [-1, 0, 1]
    assert match_lines(table, np.array([0, 1, 2]), 0.4).tolist() == [0, -1, 1], "equality counts"
    assert match_lines(table, np.array([0, 1, 2]), 0.39).tolist() == [0, -1, -1]
    assert match_lines(table[:, :0], np.array([0, 1, 2]), 0.5).tolist() == [-1, -1, -1]


def test_average_precision_by_hand() -> None:
    """T F T of four: precision 1, 1/2, 2/3; the envelope 1, 2/3, 2/3; AP = (1 + 2/3) / 4."""
    assert compute_all_point_ap(np.array([True, False, True]), 4) == pytest.approx((1 + 2 / 3) / 4)
    assert (
        compute_all_point_ap(np.array([False, False]), 4) == 0.0
        and compute_all_point_ap(np.zeros(0, dtype=bool), 4) == 0.0
    )
    assert math.isnan(compute_all_point_ap(np.array([False]), 0))


def test_equal_scores_go_by_length_then_by_place_whatever_the_order() -> None:
    parts = [straight(9, 0, 10, 0), straight(0, 0, 5, 0), straight(2, 0, 3, 0), straight(0, 9, 1, 9)]
    score = np.array([0.5, 0.5, 0.5, 0.9])
    assert rank_lines(make_lines(parts, score)).tolist() == [3, 1, 2, 0]
    back = rank_lines(make_lines(parts[::-1], score[::-1]))
    assert (3 - back).tolist() == [3, 1, 2, 0]


def test_lengths_and_bounds_are_per_line_and_empty_input_is_empty() -> None:
    lines = make_lines([np.array([[0, 0], [3, 4], [3, 5]]), straight(-1, 0, 1, 0)])
    assert lines.lengths().tolist() == [6, 2]
    assert lines.bounds().tolist() == [[0, 0, 3, 5], [-1, 0, 1, 0]]
    none: Lines = make_lines([])
    assert (
        len(none) == 0
        and none.lengths().shape == (0,)
        and compute_chamfer(none, lines, MATCHING_PROTOCOLS["exact"], 1.0).shape == (0, 2)
    )


def test_an_unknown_protocol_lists_the_known() -> None:
    with pytest.raises(ConfigError, match="known: maptr, streammapnet, exact"):
        get_matching_protocol("raster")
