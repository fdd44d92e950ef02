# SPDX-License-Identifier: Apache-2.0
"""A detector of another package works in the commands, by its entry point alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.mark.slow
def test_an_own_detector_is_evaluated_by_name(drive: Path, install, manyeyes, tmp_path: Path) -> None:
    site = install("own_detector")
    words = ("evaluate", "--data", str(drive), "--split", "test", "--weights", "clusters")
    words = (*words, "--workers", "1", "--timing-frames", "0", "--frame-stride", "5", "--out", str(tmp_path / "out"))
    done = manyeyes(site, *words, "--methods", "no-fusion", "late", "late-temporal", "early")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["result"]["rows"]
    assert [row["method"] for row in rows] == ["no-fusion", "late", "late-temporal", "early"]
    assert max(row["ap50"]["value"] for row in rows) > 0.02

    replay = (
        "replay",
        str(drive),
        "--split",
        "test",
        "--weights",
        "clusters",
        "--methods",
        "no-fusion",
        "late",
        "--no-animate",
    )
    done = manyeyes(site, *replay, "--frames", "3", "--out", str(tmp_path / "replay"))
    assert done.returncode == 0 and (tmp_path / "replay" / "report.html").is_file(), done.stderr

    refused = manyeyes(site, *words, "--methods", "intermediate")
    assert refused.returncode == 1 and "ClusterDetector is a BoxDetector: it has no tokens" in refused.stderr

    unknown = manyeyes(None, *words, "--methods", "no-fusion")
    assert (
        unknown.returncode == 1
        and "No weights are named 'clusters'; known are costr-base, costr-small" in unknown.stderr
    )
