# SPDX-License-Identifier: Apache-2.0
"""``manyeyes check`` on small recordings: what it prints of sensors, labels and files; and the note of other commands."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console
from tests.cli.test_commands import street

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datasets.recording_check import check_recording
from manyeyes.datatypes import PointCloud, Snapshot
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.sensor_domain import write_sensor_domain
from manyeyes.ops.lidar.sweep_statistics import SensorDomain
from manyeyes.studies.sensor_notes import print_sensor_note

NARROW = SensorDomain((200.0, 300.0), (0.0, 1.0), (0.0, 9.0), (0.01, 0.9))


def write(root: Path, displaced: bool = False) -> Path:
    writer = Opv2vWriter(root / "a")
    for index in range(3):
        snapshot = street("a", index)
        if displaced:
            frames = tuple(
                replace(f, points=PointCloud.of(f.points.xyz + torch.tensor([0.0, 0.0, 9.0]), f.points.intensity))
                for f in snapshot.frames
            )
            snapshot = Snapshot(snapshot.scenario, index, frames, snapshot.truth)
        writer.write(snapshot)
    writer.close({"history_frames": 1})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "narrow.safetensors"
    checkpoint.save(Detector(COSTR_TINY), path, write_sensor_domain(NARROW))
    return path


def run(capsys, *words) -> tuple[int, str]:
    code = cli.main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


@pytest.mark.parametrize("varies", [False, True])
def test_clouds_without_intensities_are_named(tmp_path, weights, capsys, varies):
    writer = Opv2vWriter(tmp_path / "a")
    snapshot = street("a", 0)
    frames = tuple(
        replace(f, points=PointCloud.of(f.points.xyz, torch.linspace(0, 1, len(f.points.xyz)) * varies))
        for f in snapshot.frames
    )
    writer.write(Snapshot(snapshot.scenario, 0, frames, snapshot.truth))
    writer.close({"history_frames": 0})
    code, text = run(capsys, "check", tmp_path, "--weights", weights)
    assert code == 0 and ("all intensities are equal" in text) is not varies


def test_a_recording_is_described(tmp_path, weights, capsys):
    root = write(tmp_path)
    code, text = run(capsys, "check", root, "--weights", weights, "--out", tmp_path / "check.json")
    assert code == 0
    for word in ("1 scenario, 3 snapshots", "no file is missing", "labels: 2 car", "0 of 4", "roadside units: points"):
        assert word in text
    assert "period [s] 0.100" in text and "trained on 200 to 300" in text and "manyeyes finetune" in text
    assert json.loads((tmp_path / "check.json").read_text())["result"]["check"]["num_listed"] == 4


def test_boxes_without_points_show_a_wrong_sign(tmp_path, weights, capsys):
    code, text = run(capsys, "check", write(tmp_path, displaced=True), "--weights", weights)
    assert code == 0 and "4 of 4" in text and "a sign, a unit or a pose is probably wrong" in text


def test_a_missing_file_is_named_and_is_no_error(tmp_path, weights, capsys):
    root = write(tmp_path)
    next((root / "a" / "5").glob("*000002.pcd"), next(iter(sorted((root / "a" / "5").glob("*.pcd"))))).unlink()
    code, text = run(capsys, "check", root, "--weights", weights)
    assert code == 0 and "missing or mismatched files: 1" in text and ".pcd" in text


def test_a_folder_that_is_no_recording_is_refused_in_one_line(tmp_path, weights, capsys):
    code, text = run(capsys, "check", tmp_path, "--weights", weights)
    assert code != 0 and "no recording in a known layout" in text


def test_time_stamps_that_stand_still_are_named(tmp_path):
    recording = Opv2vRecording(write(tmp_path))

    class Frozen:
        scenarios = recording.scenarios
        length, eval_indices, agents = recording.length, recording.eval_indices, recording.agents

        def snapshot(self, scenario: str, index: int) -> Snapshot:
            snapshot = recording.snapshot(scenario, index)
            return replace(snapshot, frames=tuple(replace(f, timestamp_ns=7) for f in snapshot.frames))

    found = check_recording(Frozen())
    assert len(found.disorder) == 2 and "does not increase" in found.disorder[0]
    assert all(sensor.period_s is None for sensor in found.sensors)


def test_a_note_is_one_line_and_only_where_weights_state_their_sensors(tmp_path, weights):
    recording, console = Opv2vRecording(write(tmp_path)), Console(record=True, width=400)
    print_sensor_note(recording, "a", Detector(COSTR_TINY), console)
    assert console.export_text() == ""
    print_sensor_note(recording, "a", checkpoint.load(weights), console)
    text = console.export_text()
    assert text.count("\n") == 1 and "beams" in text and "manyeyes finetune" in text


def test_evaluate_and_view_print_the_note(tmp_path, weights, capsys):
    root, out = write(tmp_path / "data"), tmp_path / "out"
    for words in (
        ("evaluate", "--data", root, "--split", "None", "--out", out / "e", "--frame-stride", "1"),
        ("view", root, "--out", out / "v.png", "--detect", "none"),
    ):
        code, text = run(capsys, *words, "--weights", weights)
        assert code == 0, text
        assert "trained on 200 to 300" in text.replace("\n", " ")
