# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.datatypes.map_element import BOUNDARY, DIVIDER, MapElements
from manyeyes.evaluation.maps.map_discrepancy import away, disagreement


def test_the_part_that_bends_away_is_the_piece() -> None:
    """20 m along the truth, then 20 m at 3 m beside it."""
    truth = MapElements.of([[(0, 0), (60, 0)]], DIVIDER)
    fused = MapElements.of([[(0, 0), (20, 0), (20, 3), (40, 3)]], DIVIDER)
    got = disagreement(fused, truth)
    assert len(got.invented) == 1 and got.invented[0][-1].tolist() == [40, 3]
    assert got.invented[0][0] == pytest.approx([20, 1], abs=0.51)
    assert len(got.missed) == 1 and got.missed[0][0] == pytest.approx([21, 0], abs=0.51)
    assert got.missed[0][-1].tolist() == [60, 0] and got.unexplained == []


def test_another_kind_explains_nothing_and_a_hook_below_the_shortest_piece_is_left_out() -> None:
    line = [(0, 0), (20, 0)]
    kinds = MapElements.of([line], BOUNDARY)
    assert len(away(kinds, MapElements.of([line], DIVIDER), 1.0)) == 1
    hook = MapElements.of([[(0, 0), (20, 0), (20, 2.2)]], DIVIDER)
    assert away(hook, MapElements.of([line], DIVIDER), 1.0) == []
    assert len(disagreement(MapElements.empty(), observed=hook).unexplained) == 1
    assert np.isclose(away(hook, MapElements.empty(), 1.0)[0][-1], [20, 2.2]).all()
