# SPDX-License-Identifier: Apache-2.0
"""Main tables of two training seeds: spread, pooled spread, and claims, by hand."""

from typing import Any

import pytest

from manyeyes.datatypes import ConfigError
from manyeyes.viz.seed_comparison import make_seed_comparison

CLEAN = {"delay_s": 0.0, "heading_sigma_deg": 0.0, "position_sigma_m": 0.0, "packet_loss": 0.0}


def row(method: str, ap50: float, **changes: Any) -> dict[str, Any]:
    values = [{"value": v, "low": v, "high": v} for v in (ap50, ap50 / 2)]
    kept = {"channel": "its-g5-6", "perturbation": CLEAN, "corrector": "off", "method": method, "answer_ap": values}
    return kept | changes


def table(values: dict[str, float], sides: dict[str, tuple[float, float]], level: str = "clean") -> dict[str, Any]:
    """A main table; sides: interval of ours minus a method."""
    rows = [row("no-fusion", 0.1, channel="any channel"), *(row(m, v) for m, v in values.items())]
    rows.append(row("intermediate", 0.9, corrector="voting"))
    comparisons = [
        {
            "description": f"intermediate - {method}, its-g5-6: {level}",
            "metric": f"AP@0.{iou} at the answer",
            "interval": {"value": 0.0, "low": low, "high": high},
        }
        for method, (low, high) in sides.items()
        for iou in (5, 7)
    ]
    return {"study": "main-table", "rows": rows, "comparisons": comparisons}


FIRST = {"intermediate": 0.80, "near": 0.79, "far": 0.60, "uncertain": 0.60}
SECOND = {"intermediate": 0.82, "near": 0.79, "far": 0.62, "uncertain": 0.60}
SIDES = {"near": (0.001, 0.02), "far": (0.1, 0.3), "uncertain": (0.1, 0.3)}


def test_spread_and_claims_by_hand() -> None:
    """Variances 2e-4, 0, 2e-4, 0: pooled .01. Near is 0.02 off, twice that; uncertain has no resolved second seed."""
    results = {"5": table(FIRST, SIDES), "6": table(SECOND, SIDES | {"uncertain": (-0.1, 0.3)})}
    found = make_seed_comparison(results)
    assert found.title == "AP at the answer of trainings from 2 seeds"
    assert found.lines[:6] == [
        ("disturbance", "metric", "method", "seed 5", "seed 6", "mean", "sd", "ours - method", "claimed"),
        ("clean", "AP@0.5", "intermediate", "0.800", "0.820", "0.810", "0.014", "-", "-"),
        ("clean", "AP@0.5", "near", "0.790", "0.790", "0.790", "0.000", "+0.020", "yes"),
        ("clean", "AP@0.5", "far", "0.600", "0.620", "0.610", "0.014", "+0.200", "yes"),
        ("clean", "AP@0.5", "uncertain", "0.600", "0.600", "0.600", "0.000", "+0.210", "no"),
        ("clean", "AP@0.5", "pooled", "-", "-", "-", "0.010", "-", "-"),
    ]
    assert [line[1] for line in found.lines[6:]] == ["AP@0.7"] * 5


def test_a_small_or_changing_difference_is_not_claimed() -> None:
    near = [FIRST, SECOND | {"near": 0.80}]
    small = make_seed_comparison({str(k): table(values, SIDES) for k, values in enumerate(near)})
    assert small.lines[2][-2:] == ("+0.015", "no")
    turned = [table(FIRST, SIDES), table(SECOND, SIDES | {"far": (-0.3, -0.1)})]
    assert make_seed_comparison({"5": turned[0], "6": turned[1]}).lines[3][-1] == "no"


def test_what_is_not_common_is_left_out_and_what_is_no_main_table_is_refused() -> None:
    without = {name: value for name, value in SECOND.items() if name != "far"}
    found = make_seed_comparison({"5": table(FIRST, SIDES), "6": table(without, SIDES)})
    assert [line[2] for line in found.lines[1:]] == ["intermediate", "near", "uncertain", "pooled"] * 2
    with pytest.raises(ConfigError, match="two seeds or more; got 1"):
        make_seed_comparison({"5": table(FIRST, SIDES)})
    with pytest.raises(ConfigError, match="seed 6: expected a result of 'manyeyes study main-table'"):
        make_seed_comparison({"5": table(FIRST, SIDES), "6": {"study": "robustness"}})
    with pytest.raises(ConfigError, match="no row intermediate in common"):
        make_seed_comparison({"5": table(FIRST, SIDES), "6": table({"near": 0.5}, {})})
