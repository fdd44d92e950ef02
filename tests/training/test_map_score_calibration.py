# SPDX-License-Identifier: Apache-2.0
"""Scores of a map model mean the share that is true, whatever training left them at."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.training.maps.score_calibration import MIN_SLOPE, fit_platt, novel_fraction

LINE = [[0.0, 0.0], [20.0, 0.0]]
RING = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]


def test_novel_fraction_is_length_near_a_line_of_the_same_kind():
    truth = MapElements.of([LINE, np.array(RING) + [30.0, 0.0]], [DIVIDER, CROSSING])
    beside, half = np.array(LINE) + [0.0, 0.9], np.array(LINE) + [11.0, 0.0]
    drawn = [MapElements.of([line], [DIVIDER]) for line in (beside, np.array(LINE) + [0.0, 1.1], half)]
    # The third begins 11 m along, 9 m and the metre beyond its end are true of 20.
    assert [float(novel_fraction(one, truth)[0]) for one in drawn] == pytest.approx([1.0, 0.0, 0.5], abs=0.03)
    rings = MapElements.of([np.array(RING) + [30.0, 0.5], RING], CROSSING)
    np.testing.assert_allclose(novel_fraction(rings, truth), [1, 0])
    empty = MapElements.of([], [])
    assert not novel_fraction(rings, empty).any() and novel_fraction(empty, truth).shape == (0,)


def test_duplicate_is_not_novel():
    truth = MapElements.of([LINE], [DIVIDER])
    first_half, again = np.array([[0.0, 0.3], [10.0, 0.3]]), np.array(LINE) + [0.0, -0.3]
    share = novel_fraction(MapElements.of([first_half, again, LINE], [DIVIDER] * 3), truth)
    # Of the second, what lies beyond the first's reach; of the third, nothing.
    assert share == pytest.approx([1.0, 0.46, 0.0], abs=0.04)
    # A crossing beside a divider does not match the divider.
    both = MapElements.of([RING, LINE], [CROSSING, DIVIDER])
    assert novel_fraction(both, truth)[1] == 1.0


def test_shares_that_follow_a_line_of_logits_give_that_line():
    logit = torch.linspace(-4, 4, 2001, dtype=torch.float64)
    share = torch.sigmoid(1.7 * logit + 0.6)
    scale, shift = fit_platt(logit, share)
    assert scale == pytest.approx(1.7, abs=0.03) and shift == pytest.approx(0.6, abs=0.03)


def test_few_or_none_change_little_and_the_ranking_stays():
    empty = torch.zeros(0, dtype=torch.float64)
    assert fit_platt(empty, empty) == pytest.approx((1.0, 0.0), abs=1e-6)
    scale, shift = fit_platt(torch.tensor([0.0], dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64))
    assert scale == pytest.approx(1.0) and 0.0 < shift < 0.3
    logit = torch.linspace(-3, 3, 500, dtype=torch.float64)
    assert fit_platt(logit, torch.sigmoid(-2 * logit))[0] == MIN_SLOPE
