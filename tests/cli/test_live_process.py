# SPDX-License-Identifier: Apache-2.0
"""One agent as a process: frames of a bag, the end by a signal, and its recording in the viewer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="the 'live' extra is not installed")
pytest.importorskip("mcap", reason="the 'live' extra is not installed")

from tests.cli.test_live import drive, run, weights  # noqa: F401

from manyeyes.runtime.recorder import TickEvent, read_events


@pytest.mark.slow
def test_a_bag_is_played_live(weights, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("rosbags", reason="the 'ros' extra is not installed")
    from tests.datasets.ros.test_ros_reader import write_drive

    bag, out = write_drive(tmp_path / "bag"), tmp_path / "run.json"
    words = ("--agent", 4, "--weights", weights, "--transport", "udp", "--rate", 0.1, "--out", out)
    assert run("live", "run", bag, *words) == 0
    assert json.loads(out.read_text())["frames"] >= 1


@pytest.mark.slow
def test_a_recorded_run_and_a_drive_are_logged_for_the_viewer(drive, weights, tmp_path, capsys) -> None:  # noqa: F811
    pytest.importorskip("rerun", reason="the 'rerun' extra is not installed")
    from tests.viz.test_rerun_log import column, read_back

    words = ("--split", "test", "--agent", -1, "--weights", weights, "--transport", "udp", "--frames", 3, "--rate", 0.1)
    assert run("live", "run", drive, *words, "--record", tmp_path / "run.mcap") == 0
    assert run("view", tmp_path / "run.mcap", "--rerun", tmp_path / "run.rrd") == 0
    ticks = sum(isinstance(event, TickEvent) for event in read_events(tmp_path / "run.mcap"))
    found = read_back(tmp_path / "run.rrd")
    assert len(column(found["/world/ego/boxes"], "tick")) == ticks and "/world/agents/-1/cloud" in found
    assert "differs" not in str(column(found.get("/events", []), "TextLog:text"))
    detect = ("--detect", "late", "--weights", weights)
    assert run("view", drive, "--split", "test", *detect, "--rerun", tmp_path / "drive.rrd") == 0
    found = read_back(tmp_path / "drive.rrd")
    assert any(path.startswith("/world/links/") for path in found) and "/world/truth" in found
    labels = str(column(found["/world/truth"], "Boxes3D:labels"))
    assert "missed" in labels or "truth" in labels
    assert "open it with 'rerun'" in capsys.readouterr().out


@pytest.mark.slow
def test_sigterm_ends_a_run_with_a_whole_recording(drive, weights, tmp_path) -> None:  # noqa: F811
    words = ["live", "run", drive, "--split", "test", "--agent", "-1", "--weights", weights, "--transport", "udp"]
    words += ["--rate", "0.02", "--await-start", "--record", tmp_path / "run.mcap", "--json-log"]
    command = [sys.executable, "-m", "manyeyes.cli.main", *map(str, words)]
    pipe, environment = subprocess.PIPE, {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        assert process.stdout and process.stdin and process.stderr
        assert process.stdout.readline().startswith("ready")
        from manyeyes.runtime.clock import read_tai_ns

        # Four frames at a rate of 0.02 take 15 s; the first one is recorded after a few.
        process.stdin.write(f"{read_tai_ns()} 0.02\n")
        process.stdin.flush()
        first = process.stderr.readline()
        time.sleep(7.0)
        process.send_signal(signal.SIGTERM)
        sent = time.monotonic()
        _, errors = process.communicate(timeout=60.0)
        took = time.monotonic() - sent
    assert process.returncode == 0 and took < 30.0, errors
    events = [json.loads(line)["event"] for line in [first, *errors.splitlines()]]
    assert events[0] == "start" and events[-1] == "stop"
    assert any(isinstance(event, TickEvent) for event in read_events(tmp_path / "run.mcap"))
