# SPDX-License-Identifier: Apache-2.0
"""Scores of a map model mean the share that is true, whatever training left them at."""

import numpy as np
import pytest
import torch

from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
from manyeyes.training.map_calibration import FLATTEST, platt, true_share

LINE = [[0.0, 0.0], [20.0, 0.0]]
RING = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]


def test_the_true_share_is_that_of_length_near_a_line_of_the_same_kind():
    truth = MapElements.of([LINE, np.array(RING) + [30.0, 0.0]], [DIVIDER, CROSSING])
    beside = np.array(LINE) + [0.0, 0.9]
    half = np.array(LINE) + [11.0, 0.0]
    drawn = MapElements.of(
        [beside, np.array(LINE) + [0.0, 1.1], half, np.array(RING) + [30.0, 0.5], RING], [0, 0, 0, CROSSING, CROSSING]
    )
    share = true_share(drawn, truth)
    # The third begins 11 m along, 9 m and the metre beyond its end are true of 20.
    np.testing.assert_allclose(share[[0, 1, 3, 4]], [1, 0, 1, 0])
    assert share[2] == pytest.approx(0.5, abs=0.03)
    assert not true_share(drawn, MapElements.of([], [])).any() and true_share(MapElements.of([], []), truth).shape == (
        0,
    )


def test_shares_that_follow_a_line_of_logits_give_that_line():
    logit = torch.linspace(-4, 4, 2001, dtype=torch.float64)
    share = torch.sigmoid(1.7 * logit + 0.6)
    scale, shift = platt(logit, share)
    assert scale == pytest.approx(1.7, abs=0.03) and shift == pytest.approx(0.6, abs=0.03)


def test_few_or_none_change_little_and_the_ranking_stays():
    nobody = torch.zeros(0, dtype=torch.float64)
    assert platt(nobody, nobody) == pytest.approx((1.0, 0.0), abs=1e-6)
    scale, shift = platt(torch.tensor([0.0], dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64))
    assert scale == pytest.approx(1.0) and 0.0 < shift < 0.3
    logit = torch.linspace(-3, 3, 500, dtype=torch.float64)
    assert platt(logit, torch.sigmoid(-2 * logit))[0] == FLATTEST
