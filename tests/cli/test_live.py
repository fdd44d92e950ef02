# SPDX-License-Identifier: Apache-2.0
"""A team of two processes on the loopback interface, its table and files, and the replay of each run, bit for bit."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("cryptography", reason="the 'live' extra is not installed")
pytest.importorskip("mcap", reason="the 'live' extra is not installed")

from tests.cli.test_commands import street

from manyeyes.cli import main as cli
from manyeyes.cli.live.table import load_summary
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("drive")
    writer = Opv2vWriter(root / "test" / "a")
    for index in range(4):
        writer.write(street("a", index))
    writer.close({"history_frames": 1})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {})
    return path


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["udp", "zenoh"])
def test_a_team_runs_ends_and_is_computed_again(drive, weights, tmp_path, capfd, transport: str) -> None:
    if transport == "zenoh":
        pytest.importorskip("zenoh", reason="the 'live' extra is not installed")
    words = ("--agents", 2, "--recording", drive, "--split", "test", "--weights", weights, "--rate", 0.05)
    assert run("live", "demo", *words, "--transport", transport, "--out", tmp_path / "o") == 0
    text = capfd.readouterr().out
    assert "2 processes" in text and "security require" in text and text.count("the same bit for bit") == 2
    summaries = [load_summary(path) for path in sorted((tmp_path / "o").glob("agent-*.json"))]
    assert len(summaries) == 2 and all(s.frames >= 1 and s.sent_bytes > 0 and s.recording > 0 for s in summaries)
    assert sum(s.fused for s in summaries) > 0
    again = tmp_path / "o" / "agent-5.mcap"
    assert run("live", "replay", again, "--what-if", "security=off", "strategy=late") == 0
    recorded, changed = capfd.readouterr().out.splitlines()[1:]
    assert "other than recorded in 0 of" in recorded and "security=off strategy=late: 0.00 messages fused" in changed
    assert run("live", "replay", again, "--what-if", "security=off", "--check") == 1
    assert "leave --what-if out" in capfd.readouterr().err


SOURCE = """
from dataclasses import replace
from pathlib import Path

from manyeyes.datasets.registry import open_recording
from manyeyes.runtime.sources import play_recording


def frames(agent_id, now_ns):
    recording = open_recording(Path("{drive}"), "test")
    (first, *_) = play_recording(recording, recording.scenarios[0], -1, 0)
    while True:
        yield replace(first, agent_id=agent_id, timestamp_ns=now_ns() + 50_000_000)
"""


@pytest.mark.slow
def test_frames_of_a_function_are_run_live(drive, weights, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "own_source.py").write_text(SOURCE.format(drive=drive))
    monkeypatch.chdir(tmp_path)
    words = ("--agent", 12, "--weights", weights, "--transport", "udp", "--rate", 0.2, "--out", tmp_path / "run.json")
    assert run("live", "run", "--source", "own_source:frames", *words, "--frames", 3) == 0
    summary = json.loads((tmp_path / "run.json").read_text())
    assert summary["agent_id"] == 12 and summary["frames"] >= 1
    assert run("live", "run", *words) == 1
    assert run("live", "run", drive, "--source", "own_source:frames", *words) == 1
    errors = capsys.readouterr().err.splitlines()
    assert all("Give a recording, or --source module:function, and not both." in error for error in errors)
    assert len(errors) == 2


@pytest.mark.slow
def test_one_agent_runs_alone_without_keys_and_writes_its_summary(drive, weights, tmp_path, capsys) -> None:
    out = tmp_path / "run.json"
    words = ("--split", "test", "--agent", -1, "--weights", weights, "--transport", "udp", "--frames", 2)
    assert run("live", "run", drive, *words, "--rate", 0.2, "--out", out) == 0
    assert "agent" in capsys.readouterr().out and json.loads(out.read_text())["frames"] >= 1
    assert run("live", "run", drive, *words[:3], 77, *words[4:]) == 1
    assert run("live", "run", drive, *words, "--security", "require") == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2 and "has no agent 77" in errors[0] and "needs a trust file" in errors[1]
