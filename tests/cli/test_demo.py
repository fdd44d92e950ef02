# SPDX-License-Identifier: Apache-2.0
"""The demo plays methods of one form, and keeps what it has: a map that fails leaves the report of the detections on disk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("libsumo", reason="the 'sim' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.cli.demo_map import describe_crossing_map, map_crossing
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.studies.replay_options import ALL_METHODS


@pytest.mark.slow
def test_the_fused_map_is_better_than_its_input_in_each_number(tmp_path: Path) -> None:
    stats, chapter = map_crossing(tmp_path, seed=0)
    assert chapter.table[0] == ("map", "mAP", "precision", "F1", "duplication")
    fused, union = ([float(cell) for cell in row[1:]] for row in chapter.table[1:])
    assert all(ours > theirs for ours, theirs in zip(fused[:3], union[:3])) and 1 <= fused[3] < union[3]
    line = describe_crossing_map(stats)
    assert f"mAP {fused[0]:.2f}" in line and f"unfused, {union[0]:.2f} and {union[2]:.2f}" in line


@pytest.mark.slow
def test_a_map_that_cannot_be_written_leaves_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint.save(Detector(COSTR_TINY), tmp_path / "untrained.safetensors", {})
    out = tmp_path / "demo"
    out.mkdir()
    (out / "map").write_text("a file where the map's folder would be")
    words = (
        "demo",
        "--out",
        str(out),
        "--frames",
        "1",
        "--no-animate",
        "--weights",
        str(tmp_path / "untrained.safetensors"),
    )
    assert cli.main([*words, "--towns", str(tmp_path)]) == 1
    assert str(out / "map") in capsys.readouterr().err
    assert {p.name for p in out.iterdir()} >= {
        "report.html",
        "results.json",
        "results.md",
        "no-fusion-temporal.png",
        "early-temporal.png",
    }
    held = json.loads((out / "results.json").read_text())["result"]
    assert [row["method"] for row in held["rows"]] == [f"{name}-temporal" for name in ALL_METHODS]
    assert {d["description"] for d in held["differences"]} == {
        f"intermediate-temporal - {name}-temporal" for name in ("no-fusion", "late", "early")
    }
    assert "no-fusion-temporal late-temporal intermediate-temporal early-temporal" in (out / "report.html").read_text()
