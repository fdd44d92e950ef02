# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.map_discrepancy import find_discrepancies, find_unmatched_segments


def test_the_part_that_bends_away_is_the_piece() -> None:
    """20 m along the truth, then 20 m at 3 m beside it."""
    truth = MapElements.of([[(0, 0), (60, 0)]], DIVIDER)
    fused = MapElements.of([[(0, 0), (20, 0), (20, 3), (40, 3)]], DIVIDER)
    got = find_discrepancies(fused, truth)
    assert len(got.false_positives) == 1 and got.false_positives[0][-1].tolist() == [40, 3]
    assert got.false_positives[0][0] == pytest.approx([20, 1], abs=0.51)
    assert len(got.false_negatives) == 1 and got.false_negatives[0][0] == pytest.approx([21, 0], abs=0.51)
    assert got.false_negatives[0][-1].tolist() == [60, 0] and got.unsupported == []


def test_another_kind_explains_nothing_and_a_hook_below_the_shortest_piece_is_left_out() -> None:
    line = [(0, 0), (20, 0)]
    kinds = MapElements.of([line], BOUNDARY)
    assert len(find_unmatched_segments(kinds, MapElements.of([line], DIVIDER), 1.0)) == 1
    hook = MapElements.of([[(0, 0), (20, 0), (20, 2.2)]], DIVIDER)
    assert find_unmatched_segments(hook, MapElements.of([line], DIVIDER), 1.0) == []
    assert len(find_discrepancies(MapElements.empty(), observed=hook).unsupported) == 1
    assert np.isclose(find_unmatched_segments(hook, MapElements.empty(), 1.0)[0][-1], [20, 2.2]).all()
