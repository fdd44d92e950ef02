# SPDX-License-Identifier: Apache-2.0
"""Operating characteristics and proportions by hand."""

import numpy as np
import pytest

from manyeyes.evaluation.statistics.proportion import Proportion
from manyeyes.evaluation.statistics.roc import compute_roc, count_found


def test_area_is_the_probability_that_a_positive_scores_higher() -> None:
    rng = np.random.default_rng(0)
    score, positive = rng.integers(0, 12, 200).astype(float), rng.random(200) < 0.3
    high, low = score[positive][:, None], score[~positive][None]
    by_pairs = ((high > low) + 0.5 * (high == low)).mean()
    roc = compute_roc(score, positive)
    assert roc is not None and roc.area == pytest.approx(by_pairs)
    assert (roc.num_positive, roc.num_negative) == (positive.sum(), (~positive).sum())
    assert roc.true_positive[-1] == roc.false_positive[-1] == 1.0


def test_one_class_alone_has_no_curve() -> None:
    assert compute_roc(np.ones(3), np.ones(3, bool)) is None and compute_roc(np.ones(3), np.zeros(3, bool)) is None


def test_found_at_a_rate_of_false_positives_by_hand() -> None:
    """Of twenty negatives with scores 0 to 19 one may be exceeded at 5 %: positives count above 18."""
    score = np.concatenate((np.arange(20.0), [18.0, 18.5, 30.0]))
    positive = np.arange(23) >= 20
    assert count_found(score, positive, 0.05) == Proportion.of(2, 3)
    assert count_found(score, positive, 0.0) == Proportion.of(1, 3), "no negative may be above the threshold"
    assert count_found(score, positive, 1.0) == Proportion.of(3, 3)
