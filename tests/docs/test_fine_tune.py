# SPDX-License-Identifier: Apache-2.0
"""The table of the guide to fine-tuning is that of the stored run."""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
GUIDE, STORED = ROOT / "docs/guides/fine-tune.md", ROOT / "benchmarks/results/finetune_unseen_sensor.json"
BEGIN, END = "<!-- results: finetune_unseen_sensor -->", "<!-- end -->"


def cell(interval: dict[str, Any]) -> str:
    return f"{interval['value']:.3f} [{interval['low']:.3f}, {interval['high']:.3f}]"


def table() -> str:
    stored = json.loads(STORED.read_text())
    lines = ["| weights | method | AP@0.5 | AP@0.7 | bytes/message |", "|---|---|---|---|---|"]
    for row in stored["result"]["rows"]:
        sent = f"{row['bytes_per_message']:,.0f}" if row["bytes_per_message"] else "-"
        lines.append(f"| {row['weights']} | {row['method']} | {cell(row['ap'][0])} | {cell(row['ap'][1])} | {sent} |")
    return "\n".join([*lines, "", f"`{stored['provenance']['command']}`"])


def test_the_table_is_that_of_the_stored_run() -> None:
    assert GUIDE.read_text().partition(BEGIN)[2].partition(END)[0].strip() == table()
