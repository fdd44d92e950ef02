# SPDX-License-Identifier: Apache-2.0
"""The calibrated probabilities of existence: where they come from, their inverse, and the thresholds that they give."""

import importlib.util
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from manyeyes.datatypes.map_element import CROSSING, DIVIDER
from manyeyes.maps.fusion.existence import EvidenceConfig
from manyeyes.maps.fusion.existence_calibration import CROSSING_PROB, LINE_PROB, LOG_ODDS, find_log_odds

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
COUNTS = ("stations", "existing")
both = pytest.mark.parametrize(("element", "table"), [("line", LINE_PROB), ("crossing", CROSSING_PROB)])


@pytest.fixture(scope="module")
def benchmark():
    pytest.importorskip("shapely")
    spec = importlib.util.spec_from_file_location(
        "existence_calibration_benchmark", BENCHMARKS / "existence_calibration.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@both
def test_the_tables_follow_from_the_stored_counts(benchmark, element, table):
    stored = json.loads((BENCHMARKS / "results" / "maps" / "existence.json").read_text())["result"]
    assert stored["log_odds"] == list(LOG_ODDS)
    rows = [
        [row for row in stored["rows"] if (row["element"], row["agents"]) == (element, n)] for n in benchmark.CLASSES
    ]
    counts, existing = (np.array([np.sum([row[name] for row in own], 0) for own in rows]) for name in COUNTS)
    if element == "crossing":
        counts, existing = (np.stack((a[0] + a[1], a[0] + a[1], *a[2:])) for a in (counts, existing))
    np.testing.assert_array_equal(np.round(benchmark.fit_monotone(counts, existing), 2), table)


@both
def test_probabilities_grow_with_log_odds_and_with_agents(element, table):
    assert (np.diff(table, axis=0) >= 0).all() and (np.diff(table, axis=1) >= 0).all()
    assert np.shape(table) == (4, len(LOG_ODDS))


def test_violators_are_pooled_and_columns_of_few_stations_take_the_one_before(benchmark):
    counts = np.array([[10, 10, 10, 1, 10], [10, 0, 0, 0, 10], [10, 10, 10, 10, 10]])
    true = np.array([[2, 8, 6, 1, 9], [1, 0, 0, 0, 9], [5, 5, 5, 5, 5]])
    fitted = benchmark.fit_monotone(counts, true)
    np.testing.assert_allclose(fitted[0], [0.2, 0.7, 0.7, 0.7, 0.9])
    # Two agents: 0.1, then 0.9, below those of one agent but at the last.
    np.testing.assert_allclose(fitted[1], [0.2, 0.7, 0.7, 0.7, 0.9])
    np.testing.assert_allclose(fitted[2], [0.5, 0.7, 0.7, 0.7, 0.9])


def test_stations_count_at_the_nearest_log_odds_in_their_class(benchmark):
    stations = np.array([[1.54, 0, 1], [1.3, 0, 0], [1.2, 0, 0], [6.0, 3, 1], [0.1, 2, 0], [-0.1, 2, 1]])
    one_view, one, two, many = benchmark.tally("line", 20, stations)
    assert one_view.stations[LOG_ODDS.index(1.5)] == 2 and one_view.existing[LOG_ODDS.index(1.5)] == 1
    assert one_view.stations[LOG_ODDS.index(1.0)] == 1 and sum(one_view.stations) == 3 and sum(one.stations) == 0
    assert sum(two.stations) == two.stations[0] == 1 and sum(two.existing) == 0
    assert many.stations[-1] == many.existing[-1] == 1


@pytest.mark.parametrize("row", LINE_PROB[:3])
@pytest.mark.parametrize("prob", [0.8, 0.82])
def test_the_least_log_odds_reach_the_probability(row, prob):
    least = find_log_odds(row, prob)
    assert np.interp(least, LOG_ODDS, row) == pytest.approx(prob)
    assert np.interp(least - 0.01, LOG_ODDS, row) < prob


def test_a_probability_that_no_evidence_of_one_agent_reaches_needs_two():
    one_view, one, two, many = EvidenceConfig(min_publish_prob=0.97).publish_log_odds()[DIVIDER]
    assert one_view == one == math.inf and 3.0 < two < 4.0 and many == pytest.approx(1.5)
    assert find_log_odds(LINE_PROB[0], 0.0) == LOG_ODDS[0]
    assert (EvidenceConfig(min_publish_prob=0.0).publish_log_odds() == 0.0).all()


def test_the_default_publishes_one_sure_detection_and_less_where_more_agents_agree():
    lines, crossings = EvidenceConfig().publish_log_odds()[[DIVIDER, CROSSING]]
    assert 1.0 < lines[0] < EvidenceConfig().log_odds_hit()
    assert (np.diff(lines) <= 0).all() and lines[1] < 0.5
    assert (crossings <= lines[0]).all()
