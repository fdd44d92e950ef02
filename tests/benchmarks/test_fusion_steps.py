# SPDX-License-Identifier: Apache-2.0
"""The table of training steps in the documentation is that of the stored result, which has every compared fusion."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

from manyeyes.training.detector.fusion_presets import FUSION_TRAINING_PRESETS

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "papers" / "baselines.md"


def load_benchmark():
    spec = importlib.util.spec_from_file_location("fusion_steps", ROOT / "benchmarks" / "fusion_steps.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_holds_the_stored_table() -> None:
    module = load_benchmark()
    rows = json.loads((ROOT / "benchmarks" / "results" / "fusion_steps.json").read_text())["presets"]
    compared = {name for name in FUSION_TRAINING_PRESETS if not name.startswith("stage-c/")}
    assert compared | set(module.STAGES) == set(rows)
    assert module.format_table(rows) in PAGE.read_text()
    assert all(rows[name]["steps"] == FUSION_TRAINING_PRESETS[name].steps for name in compared)


def test_hours_are_those_of_all_steps() -> None:
    row = {"seconds": 0.5, "steps": 7200, "fusion_parameters": 12345}
    assert load_benchmark().format_table({"a": row}).splitlines()[-1] == "| `a` | 0.50 | 7200 | 1.00 | 12,345 |"
