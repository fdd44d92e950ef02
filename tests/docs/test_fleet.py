# SPDX-License-Identifier: Apache-2.0
import json
import re
from pathlib import Path

import pytest

from manyeyes.simulator.fleet import CROWDS, PLACES

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "reference" / "fleet.md").read_text(encoding="utf-8")


def test_the_example_runs(capsys):
    pytest.importorskip("shapely")
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "docs/reference/fleet.md", "exec"), {})
    assert capsys.readouterr().out == "20 observations, 40 true elements\n"


def test_the_page_names_every_preset_and_place():
    assert [name for name in CROWDS if f"`{name}`" not in PAGE] == []
    towns = [name for name in PLACES if name.startswith("Town")]
    assert [name for name in PLACES if f"`{name}`" not in PAGE and name not in towns] == []


def test_the_costs_are_those_that_were_kept():
    rows = json.loads((ROOT / "benchmarks" / "results" / "crowd.json").read_text())["result"]["rows"]
    assert len(rows) >= 7
    for row in rows:
        shown = f"| {row['crowd']} | {row['elements']:.1f} | {row['ms']:.2f} |"
        assert [line for line in PAGE.splitlines() if f"`{row['place']}`" in line and shown in line], shown
