# SPDX-License-Identifier: Apache-2.0
"""The tables of a model card are those of its stored results, and stay between their markers."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SPEC = importlib.util.spec_from_file_location("model_card", REPOSITORY / "scripts" / "model_card.py")
assert SPEC is not None and SPEC.loader is not None
model_card = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(model_card)


def interval(value: float | None, scenarios: int = 4) -> dict[str, Any]:
    return {"value": value, "low": (value or 0) - 0.1, "high": (value or 0) + 0.1, "num_scenarios": scenarios}


def sensors_row(recording: str, law: str, sweeps: int, value: float) -> dict[str, Any]:
    pair = [interval(value, 1), interval(value, 1)]
    return {"recording": recording, "law": law, "sweeps": sweeps, "tilt_deg": 0.0, "method": "intermediate", "ap": pair}


RESULTS: dict[str, dict[str, Any]] = {
    "a-evaluate": {
        "stats": [],
        "rows": [
            {"method": "none", "ap50": interval(0.5), "ap70": interval(None), "bytes_per_message": None},
            {"method": "late", "ap50": interval(0.6), "ap70": interval(0.4), "bytes_per_message": 1234.4},
        ],
    },
    "b-sensors": {
        "study": "sensors",
        "rows": [sensors_row(f"beams-{n}", law, s, 0.1 * s) for n in (16, 32) for law in ("zero", "carla") for s in (2, 1)],
    },
    "c-strata": {
        "study": "strata",
        "rows": [
            {"stratum": "t", "method": "none", "num_scenarios": 3, "ap": [interval(0.5), interval(0.4)], "bytes_per_message": 0}
        ],
    },
    "d-cases": {
        "command": "python unseen_scenes.py",
        "cases": [
            {
                "case": "argoverse2", "frames": 2, "vehicles": 18, "matched": 9, "under_crowns": 8, "matched_under_crowns": 1,
                "false_boxes": 46,
            }
        ],
    },
}  # fmt: skip


@pytest.fixture
def results(tmp_path) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    for name, result in RESULTS.items():
        stored = {"provenance": {"command": f"manyeyes {name}", "git_commit": "0123456789abcdef"}, "result": result}
        (folder / f"{name}.json").write_text(json.dumps(stored))
    return folder


def test_tables_are_written_once_between_their_markers(results, tmp_path):
    card = tmp_path / "card.md"
    card.write_text("# weights\n\nText.\n")
    assert model_card.main([str(card), str(results), "--check"]) == 1
    assert model_card.main([str(card), str(results)]) == 0
    text = re.sub(" +", " ", card.read_text())
    assert text.startswith("# weights\n\nText.\n\n" + model_card.BEGIN)
    assert "| none | 0.500 [0.400, 0.600] | - | - |" in text and "| 0.400 [0.300, 0.500] | 1,234 |" in text
    assert "| intensity | beams-16, 2 sweeps | beams-16, 1 sweep | beams-32, 2 sweeps | beams-32, 1 sweep |" in text
    assert "| zero | 0.200 | 0.100 | 0.200 | 0.100 |" in text
    assert "| argoverse2 | 2 | 18 | 9 | 46 | 1 of 8 |" in text
    assert "`python unseen_scenes.py`, commit 0123456789ab." in text and "`manyeyes c-strata`" in text
    card.write_text(card.read_text() + "\nAfter.\n")
    again = card.read_text()
    assert model_card.main([str(card), str(results)]) == 0 and card.read_text() == again
    assert model_card.main([str(card), str(results), "--check"]) == 0


def test_what_is_no_result_is_refused(results, tmp_path, capsys):
    card = tmp_path / "card.md"
    card.write_text("# weights\n")
    (results / "e.json").write_text(json.dumps({"provenance": {"command": "", "git_commit": None}, "result": {}}))
    assert model_card.main([str(card), str(results)]) == 1
    assert "e.json: no result of evaluate" in capsys.readouterr().err
    (results / "e.json").unlink()
    card.write_text(f"{model_card.BEGIN}\n")
    assert model_card.main([str(card), str(results)]) == 1 and "without" in capsys.readouterr().err
