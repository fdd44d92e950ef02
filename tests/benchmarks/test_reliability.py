# SPDX-License-Identifier: Apache-2.0
"""The benchmark of reliability keeps the bins of each method."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks import reliability
from manyeyes.evaluation.statistics.reliability import compute_reliability


def test_rows_are_the_reliability_of_each_method(monkeypatch: pytest.MonkeyPatch) -> None:
    found = compute_reliability(np.array([0.15, 0.95, 0.95]), np.array([False, True, True]))
    tallies = [SimpleNamespace(method=name, compute_reliability=lambda: found) for name in ("late", "early")]
    monkeypatch.setattr(reliability, "run_benchmarks", lambda opener, configs, workers: [tallies])
    rows = reliability.measure(cast(Any, None), cast(Any, None))
    assert [row.method for row in rows] == ["late", "early"]
    assert [part.count for part in rows[0].bins] == [1, 2] and rows[0].expected_error == pytest.approx(0.25 / 3)
