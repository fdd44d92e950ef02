# SPDX-License-Identifier: Apache-2.0
"""The slope of memory of a soak: a leak is found, noise and steps at the begin are none, and the interval covers the truth."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cryptography", reason="the extra live is not installed")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

from live_soak import estimate_slope, theil_sen

TIME_S = np.arange(0.0, 3_600.0, 10.0)


def test_a_leak_of_six_mb_an_hour_is_found_and_noise_is_none() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.5, len(TIME_S))
    leak = estimate_slope(TIME_S, 400.0 + 6.0 * TIME_S / 3_600.0 + noise)
    assert leak.low < 6.0 < leak.high and leak.low > 4.0 and leak.num == len(TIME_S)
    none = estimate_slope(TIME_S, 400.0 + noise)
    assert none.low < 0.0 < none.high and none.high < 2.0


def test_a_few_outliers_do_not_move_the_slope() -> None:
    values = 400.0 + 3.6 * TIME_S / 3_600.0
    values[[3, 50, 99]] += 80.0
    assert 3_600 * theil_sen(TIME_S, values) == pytest.approx(3.6, abs=0.05)
