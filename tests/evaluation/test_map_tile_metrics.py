# SPDX-License-Identifier: Apache-2.0
"""Rows of the map model's studies, on drawings whose numbers can be counted by hand."""

import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, CROSSING, DIVIDER, MapElements
from manyeyes.evaluation.maps.tile_metrics import TileTable, split_by_curvature
from manyeyes.evaluation.maps.tile_prediction import ScenarioPredictions, TilePrediction

LINES = [[[0.0, 12.0 * k], [30.0, 12.0 * k]] for k in range(4)]
RING = [[40.0, 0.0], [44.0, 0.0], [44.0, 3.0], [40.0, 3.0]]
TRUTH = MapElements.of([*LINES, RING, [[0.0, 90.0], [30.0, 90.0]]], [DIVIDER] * 4 + [CROSSING, BOUNDARY])


def cells() -> list[ScenarioPredictions]:
    """Four scenarios at two seeds: "all" draws everything; "half" two of the lines and, in two scenarios, the crossing."""
    out = []
    for k in range(4):
        half = TRUTH.take(np.array([0, 1, 4] if k < 2 else [0, 1]))
        for seed in (0, 1):
            drawn = (
                TilePrediction("half", half, TRUTH, (100,)),
                TilePrediction("all", TRUTH, TRUTH, (100, 100 + 10 * k)),
            )
            out.append(ScenarioPredictions(f"s{k}", seed, drawn))
    return out


@pytest.fixture(scope="module")
def table():
    return TileTable(cells())


def test_a_row_holds_ap_by_kind_mean_and_bytes(table):
    half, whole = table.make_row("half"), table.make_row("all")
    assert table.names == ("half", "all") and (half.num_tiles, half.frames_per_tile, half.bytes_per_tile) == (
        8,
        1.0,
        100.0,
    )
    assert (whole.frames_per_tile, whole.bytes_per_frame, whole.bytes_per_tile) == (2.0, 107.5, 215.0)
    for way in range(2):
        assert [i.value for i in half.ap[way]] == pytest.approx([0.5, 0.5, 0.0])
        assert half.mean_ap[way].value == pytest.approx(0.5) and whole.mean_ap[way].low == 1.0
    assert half.mean_ap_by_seed == pytest.approx((0.5, 0.5)) and half.mean_ap[0].num_scenarios == 4
    assert half.ap[0][1].low == half.ap[0][1].high == 0.5, "every scenario has half of the dividers"
    assert half.ap[0][0].low == 0.0 and half.ap[0][0].high == 1.0, "crossings differ among scenarios"


def test_a_comparison_is_a_paired_difference(table):
    comparison = table.compare("all - half", "all", "half")
    assert (comparison.description, comparison.metric) == ("all - half", "mAP")
    assert comparison.interval.value == pytest.approx(0.5) and comparison.interval.low == pytest.approx(0.25)


def test_classes_without_ground_truth_are_not_averaged():
    lines = TRUTH.take(np.arange(4))
    table = TileTable([ScenarioPredictions("a", 0, (TilePrediction("row", lines, lines, ()),))])
    row = table.make_row("row")
    assert row.mean_ap[0].value == 1.0 and np.isnan(row.ap[0][0].value) and row.bytes_per_frame == 0.0


def test_tiles_with_curved_dividers_are_split_from_straight_ones():
    angle = np.linspace(0, 1, 50)
    arc = MapElements.of([50.0 * np.stack((np.sin(angle), 1 - np.cos(angle)), 1)], DIVIDER)
    predictions = (TilePrediction("row", arc, arc, ()), TilePrediction("row", TRUTH.take([0]), TRUTH, ()))
    split = split_by_curvature([ScenarioPredictions("a", 0, predictions), ScenarioPredictions("b", 0, predictions[1:])])
    assert {name: [(r.scenario, len(r.predictions)) for r in part] for name, part in split.items()} == {
        "straight": [("a", 1), ("b", 1)],
        "curved": [("a", 1)],
    }
    assert TileTable(split["curved"]).make_row("row").ap[1][1].value == 1.0
    assert TileTable(split["straight"]).make_row("row").ap[1][1].value == pytest.approx(0.25)
    assert list(split_by_curvature([ScenarioPredictions("b", 0, predictions[1:])])) == ["straight"]
