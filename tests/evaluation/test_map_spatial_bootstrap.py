# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from manyeyes.datatypes.map_element import DIVIDER, MapElements
from manyeyes.evaluation.maps.metrics import evaluate_map
from manyeyes.evaluation.maps.spatial_bootstrap import bootstrap_ap_interval, bootstrap_f1_interval
from manyeyes.evaluation.statistics.bootstrap import draw_resamples


def streets(good: int, bad: int, spare: int = 0, score=1.0) -> tuple[MapElements, MapElements]:
    """A true line of 20 m in each square of a row; the map has the first ones, and invents 10 m aside of the next."""
    truth = [[(64.0 * k + 22, 32.0), (64.0 * k + 42, 32.0)] for k in range(good + bad + spare)]
    found = truth[:good] + [[(x0, y + 10), (x1, y + 10)] for (x0, y), (x1, _) in truth[good : good + bad]]
    return MapElements.of(found, DIVIDER, score), MapElements.of(truth, DIVIDER)


def test_the_value_is_the_maps_own_number_and_lies_in_its_interval() -> None:
    draw = np.random.default_rng(4)
    mine, truth = streets(9, 5, 3, draw.uniform(0, 1, 14).round(1))
    quality = evaluate_map(mine, truth)
    for way in ("maptr", "streammapnet", "exact"):
        got = bootstrap_ap_interval(mine, truth, "divider", way)
        assert got.value == pytest.approx(quality.get_ap("divider", way), abs=1e-12)
        assert 0 < got.low < got.value < got.high < 1 and got.num_scenarios == 17
    got = bootstrap_f1_interval(mine, truth, "divider")
    assert got.value == pytest.approx(quality.get_length_score("divider").f1) and got.low < got.value < got.high


def test_recall_of_equal_squares_has_the_binomials_interval() -> None:
    """No inventions: AP is the share of found squares in the draw, whose mean over draws can be counted by hand."""
    mine, truth = streets(10, 0, 10)
    got = bootstrap_ap_interval(mine, truth, "divider", num_resamples=400)
    share = draw_resamples(20, 400, 0)[:, :10].sum(1) / 20
    assert (got.low, got.high) == pytest.approx(tuple(np.quantile(share, [0.025, 0.975])))


def test_a_perfect_map_is_perfect_in_every_draw_and_without_truth_there_is_no_number() -> None:
    mine, truth = streets(5, 0)
    assert bootstrap_ap_interval(mine, truth, "divider").low == bootstrap_f1_interval(mine, truth, "divider").low == 1.0
    assert math.isnan(bootstrap_ap_interval(mine, MapElements.empty(), "divider").value)
    assert math.isnan(bootstrap_f1_interval(mine, MapElements.empty(), "divider").value)
    nothing = bootstrap_ap_interval(MapElements.empty(), truth, "divider")
    assert (nothing.value, nothing.high) == (0.0, 0.0)
    assert math.isnan(bootstrap_ap_interval(MapElements.empty(), MapElements.empty(), "crossing").value)
