# SPDX-License-Identifier: Apache-2.0
"""A fusion module and a strategy of another package work in the commands, by their entry points alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from safetensors import safe_open


@pytest.mark.slow
def test_an_own_fusion_module_is_trained_and_evaluated_with_an_own_strategy(
    drive: Path, install, manyeyes, tmp_path: Path
) -> None:
    site, run = install("own_method"), tmp_path / "run"
    train = ("train", "--data", str(drive), "--preset", "costr-tiny", "--steps", "2", "--out", str(run))
    done = manyeyes(site, *train, "--fusion", "mean")
    assert done.returncode == 0, done.stderr
    with safe_open(run / "weights.safetensors", "pt") as file:
        assert json.loads(file.metadata()["config"])["fusion"] == "mean"

    words = ("evaluate", "--data", str(drive), "--split", "test", "--workers", "1", "--timing-frames", "0")
    words = (*words, "--weights", str(run / "weights.safetensors"), "--out", str(tmp_path / "out"))
    words = (*words, "--frame-stride", "5", "--methods", "moving-first", "intermediate")
    done = manyeyes(site, *words)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["result"]["rows"]
    assert [row["method"] for row in rows] == ["moving-first", "intermediate"]

    # Without the entry points neither name is known.
    assert "No fusion module is called 'mean'; known: attfuse" in manyeyes(None, *train, "--fusion", "mean").stderr
    unknown = manyeyes(None, *words)
    assert unknown.returncode == 1 and "No strategy is called 'moving-first'; known: early" in unknown.stderr
