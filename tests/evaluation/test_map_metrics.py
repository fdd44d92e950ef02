# SPDX-License-Identifier: Apache-2.0
"""Maps drawn by hand, evaluated; every number is worked out beside the drawing."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, KINDS, MapElements
from manyeyes.evaluation.maps.metrics import evaluate_map, find_branches, frechet

TWO_LANES = [[(0, 0), (40, 0)], [(0, 3.5), (40, 3.5)]]


def dividers(*lines, score=1.0) -> MapElements:
    return MapElements.of([np.array(line, dtype=float) for line in lines], DIVIDER, score)


def test_the_truth_itself_is_perfect_in_every_number() -> None:
    truth = MapElements.cat([dividers(*TWO_LANES), MapElements.of([[(10, 0), (14, 0), (14, 8), (10, 8)]], CROSSING)])
    got = evaluate_map(truth, truth)
    for way in ("maptr", "streammapnet", "exact"):
        assert got.mean_ap(way) == got.mean_ap(way, "wide") == 1.0
    line = got.get_kind("divider")
    assert (line.duplication, line.fragmentation, line.frechet_m, line.endpoint_error_m) == (1.0, 1.0, 0.0, 0.0)
    assert line.lateral_median_m == line.lateral_p95_m == 0.0
    assert [(s.precision, s.recall, s.f1) for s in line.length_scores] == [(1.0, 1.0, 1.0)] * 3
    assert math.isnan(got.get_kind("boundary").ap_scores[0].ap) and got.get_kind("boundary").n_truth == 0


def test_a_kind_without_truth_is_left_out_of_the_mean_but_its_inventions_cost_precision() -> None:
    truth = dividers(*TWO_LANES)
    invented = MapElements.cat([truth, MapElements.of([[(0, 9), (40, 9)]], BOUNDARY)])
    got = evaluate_map(invented, truth)
    assert got.mean_ap(kinds=KINDS) == 1.0
    assert got.get_kind("boundary").length_scores[0].precision == 0.0 and math.isnan(
        got.get_kind("boundary").length_scores[0].f1
    )


def test_a_double_and_a_miss_by_hand() -> None:
    """The better copy is found first: hits T, then F; recall 1/2. 80 m of 80 m, but all on one line: F by length 1/2 and 2/3.

    predicted   ======== (twice, 0.2 m aside)        truth  --------  y = 0
                                                            --------  y = 3.5
    """
    mine = dividers([(0, 0.2), (40, 0.2)], [(0, -0.2), (40, -0.2)], score=[0.9, 0.8])
    got = evaluate_map(mine, dividers(*TWO_LANES)).get_kind("divider")
    assert next(p.ap_at_threshold for p in got.ap_scores if p.protocol == "exact") == (0.5, 0.5, 0.5)
    assert (got.n_predicted, got.n_truth, got.duplication, got.fragmentation) == (2, 2, 1.0, 2.0)
    assert got.length_scores[0].precision == 1.0 and got.length_scores[0].recall == 0.5
    assert got.length_scores[0].f1 == pytest.approx(2 / 3)
    assert got.lateral_median_m == pytest.approx(0.2) and got.lateral_p95_m == pytest.approx(0.2)
    assert got.frechet_m == pytest.approx(0.2)


def test_pieces_of_a_line_have_its_length_but_not_its_ap() -> None:
    mine = dividers(*[[(x, 0), (x + 10, 0)] for x in range(0, 40, 10)])
    got = evaluate_map(mine, dividers([(0, 0), (40, 0)])).get_kind("divider")
    assert got.length_scores[0].f1 == 1.0 and got.duplication == 1.0 and got.fragmentation == 4.0
    assert {p.ap for p in got.ap_scores} == {0.0}


def test_a_score_below_another_costs_nothing_where_the_other_is_true() -> None:
    """Hit 0.9, false 0.5: AP 1. False 0.9, hit 0.5: AP 1/2."""
    line, far = [(0, 0), (40, 0)], [(0, 30), (40, 30)]
    truth = dividers(line)
    assert evaluate_map(dividers(line, far, score=[0.9, 0.5]), truth).get_ap("divider") == 1.0
    assert evaluate_map(dividers(line, far, score=[0.5, 0.9]), truth).get_ap("divider") == 0.5


def test_length_counts_what_lies_within() -> None:
    """Half of the predicted line bends 2 m away; half of the truth is never predicted."""
    mine = dividers([(0, 0.4), (20, 0.4), (20, 2.4), (38, 2.4)])
    got = evaluate_map(mine, dividers([(0, 0), (60, 0)])).get_kind("divider")
    by_distance = {s.max_distance_m: s for s in got.length_scores}
    assert by_distance[0.3].precision == by_distance[0.3].recall == by_distance[0.3].f1 == 0.0
    assert by_distance[0.5].precision == pytest.approx(20 / 40, abs=0.26 / 40)
    assert by_distance[0.5].recall == pytest.approx(20 / 60, abs=0.5 / 60)


def test_ends_and_branches() -> None:
    """Three lines meet at (20, 0); the map lets two of them end 1.5 m short of it, and joins no third."""
    truth = dividers([(0, 0), (20, 0)], [(20, 0), (40, 5)], [(20, 0), (40, -5)])
    perfect = evaluate_map(truth, truth).get_kind("divider")
    assert (perfect.branch_f1, perfect.endpoint_error_m) == (1.0, 0.0)
    short = dividers([(0, 0), (20, 0)], [(22.5, 0), (40, 5)], [(22.5, 0), (40, -5)])
    got = evaluate_map(short, truth).get_kind("divider")
    assert got.branch_f1 == 0.0 and got.endpoint_error_m == 0.0
    assert math.isnan(evaluate_map(dividers(*TWO_LANES), dividers(*TWO_LANES)).get_kind("divider").branch_f1)
    lost = evaluate_map(dividers([(500, 0), (520, 0)]), truth).get_kind("divider")
    assert lost.endpoint_error_m == 10.0


def test_branches_are_groups_of_three_joined_in_a_chain() -> None:
    ends = np.array([[0, 0], [0.9, 0], [1.8, 0], [10, 0], [10.2, 0], [20, 5]], dtype=float)
    assert find_branches(ends).tolist() == [[pytest.approx(0.9), 0.0]]
    assert find_branches(ends[[4, 2, 5, 0, 3, 1]]).tolist() == [[pytest.approx(0.9), 0.0]]
    assert find_branches(np.zeros((0, 2))).shape == (0, 2)


def slow_frechet(a, b):
    """The recursion of Eiter and Mannila as it is printed."""
    from functools import cache

    @cache
    def reach(i: int, j: int) -> float:
        d = math.dist(a[i], b[j])
        if i == 0 and j == 0:
            return d
        before = [reach(p, q) for p, q in ((i - 1, j), (i - 1, j - 1), (i, j - 1)) if p >= 0 and q >= 0]
        return max(min(before), d)

    return reach(len(a) - 1, len(b) - 1)


@given(seed=st.integers(0, 10**6))
def test_frechet_is_the_recursion(seed: int) -> None:
    draw = np.random.default_rng(seed)
    a, b = draw.normal(0, 3, (draw.integers(1, 9), 2)), draw.normal(0, 3, (draw.integers(1, 9), 2))
    assert frechet(a, b) == pytest.approx(slow_frechet(a.tolist(), b.tolist()), abs=1e-12)


def test_an_empty_map_has_recall_zero_and_no_precision() -> None:
    got = evaluate_map(MapElements.empty(), dividers(*TWO_LANES)).get_kind("divider")
    assert {p.ap for p in got.ap_scores} == {0.0} and got.duplication == 0.0
    assert (
        math.isnan(got.length_scores[0].precision)
        and got.length_scores[0].recall == 0.0
        and got.length_scores[0].f1 == 0.0
    )
    assert math.isnan(evaluate_map(dividers(*TWO_LANES), MapElements.empty()).mean_ap())


def test_elements_without_length_are_left_out() -> None:
    mine = dividers([(0, 0), (40, 0)], [(1, 1), (1, 1)], [(2, 2)], score=[0.5, 0.9, 0.9])
    got = evaluate_map(mine, dividers([(0, 0), (40, 0)]))
    assert got.get_kind("divider").n_predicted == 1 and got.get_ap("divider") == 1.0
