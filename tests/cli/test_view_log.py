# SPDX-License-Identifier: Apache-2.0
"""'view --rerun' and 'view --mcap' log the same frames, which are read back; broken input is one line, and leaves no file."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("mcap", reason="the extra live is not installed")
pytest.importorskip("rerun", reason="the extra rerun is not installed")

from tests.cli.test_live import drive, run, weights  # noqa: F401
from tests.viz import test_foxglove_log as foxglove
from tests.viz.test_rerun_log import column, read_back


@pytest.mark.slow
def test_both_files_hold_the_same_boxes_of_the_same_frames(drive, weights, tmp_path, capsys) -> None:  # noqa: F811
    words = ("--split", "test", "--detect", "late", "--weights", weights, "--min-score", 0.0, "--frames", 2)
    assert run("view", drive, *words, "--rerun", tmp_path / "a.rrd", "--mcap", tmp_path / "a.mcap") == 0
    text = capsys.readouterr().out
    assert "2/2" in text and "a.mcap: 2 frames; open it with Foxglove" in text and "a.rrd: 2 frames; open it" in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.rrd"]
    rerun, messages = read_back(tmp_path / "a.rrd"), foxglove.read(tmp_path / "a.mcap")
    assert column(rerun["/world/ego/boxes"], "tick") == [1, 2]
    for group in ("ego/boxes", "truth"):
        logged = column(rerun[f"/world/{group}"], "Boxes3D:centers")
        written = [
            [list(entity["cubes"][0]["pose"]["position"].values()) for entity in update["entities"]]
            for _, _, update in messages[f"/{group}"]
        ]
        assert len(logged) == len(written) == 2 and logged[0]
        assert all(np.allclose(one, other) for one, other in zip(logged, written))
    (link,) = messages["/links"][0][2]["entities"]
    label = column(rerun["/world/links/-1-5"], "LineStrips3D:labels")[0]
    pairs = {pair["key"]: pair["value"] for pair in link["metadata"]}
    assert label == [f"{pairs['bytes']} B, {pairs['age_ms']} ms"] and int(pairs["bytes"]) > 0
    assert {"/plots/counts/matched", "/plots/counts/false", "/plots/counts/missed"} <= rerun.keys()


@pytest.mark.slow
def test_a_map_is_logged_in_the_world_of_the_drive(drive, tmp_path) -> None:  # noqa: F811
    pytest.importorskip("pyarrow", reason="the extra map is not installed")
    from manyeyes.datatypes.map_element import CROSSING, DIVIDER, MapElements
    from manyeyes.maps.elements.observation import MapFrame
    from manyeyes.maps.elements.vector_map import VectorMap
    from manyeyes.studies.map_folder import write_vector_map

    square = [[0.0, 0.0], [2.0, 0.0], [2.0, 4.0], [0.0, 4.0]]
    elements = MapElements.of([[[0.0, 1.0], [5.0, 1.0]], square], [DIVIDER, CROSSING])
    write_vector_map(VectorMap.of(elements, MapFrame()), tmp_path / "map")
    words = ("--split", "test", "--frame", 0, "--map", tmp_path / "map", "--rerun", tmp_path / "a.rrd")
    assert run("view", drive, *words) == 0
    found = read_back(tmp_path / "a.rrd")
    # Nothing is known of this place: its map's zero is where the first agent began, which is the world's here.
    (divider,) = column(found["/world/map/divider"], "LineStrips3D:strips")
    (crossing,) = column(found["/world/map/crossing"], "LineStrips3D:strips")
    assert [point[:2] for point in divider[0]] == [[0.0, 1.0], [5.0, 1.0]]
    ring = [point[:2] for point in crossing[0]]
    assert ring[0] == ring[-1] and {tuple(point) for point in ring} >= {tuple(point) for point in square}
    assert column(found["/world/map/divider"], "tick") == [0] and len(column(found["/world/truth"], "tick")) == 4


ERRORS = {
    "--mcap out.png": "--mcap ends in .mcap; got out.png",
    "--rerun out.png": "A target of the viewer is a file .rrd, web or web:PORT",
    "--rerun web:0": "with a port from 1 to 65535",
    "--rerun rerun+http://127.0.0.1:1/proxy": "no viewer answers",
    "--mcap a.mcap --frame 4": "a has no frame 4; choose one of 0 to 3.",
    "--out a.png --frame 4": "a has no frame 4; choose one of 0 to 3.",
    "--mcap a.mcap --scenario none": "There is no scenario 'none'",
    "--out a.png --map .": "--map needs --rerun or --mcap.",
    "--out a.png --cloud-color intensity": "--cloud-color needs --rerun or --mcap.",
    "--rerun a.rrd --map .": "lines.parquet",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", ERRORS)
def test_wrong_options_are_one_line_and_leave_nothing(drive, tmp_path, monkeypatch, capsys, words: str) -> None:  # noqa: F811
    monkeypatch.chdir(tmp_path)
    assert run("view", drive, "--split", "test", *words.split()) == 1
    error = capsys.readouterr().err
    assert ERRORS[words] in error and error.startswith("manyeyes: ") and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--rerun", "--mcap"])
@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"no recording" * 100], ids=["empty", "cut", "other"])
def test_a_broken_recording_of_a_run_is_one_line(tmp_path, capsys, option: str, content: bytes) -> None:
    (tmp_path / "run.mcap").write_bytes(content)
    out = tmp_path / ("a" + {"--rerun": ".rrd", "--mcap": ".mcap"}[option])
    assert run("view", tmp_path / "run.mcap", option, out) == 1
    error = capsys.readouterr().err
    assert "run.mcap: no whole recording of a live run" in error and error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_a_recording_is_not_overwritten_by_its_view(tmp_path, capsys) -> None:
    (tmp_path / "run.mcap").write_bytes(b"precious")
    assert run("view", tmp_path / "run.mcap", "--mcap", tmp_path / "." / "run.mcap") == 1
    assert "is the recording itself" in capsys.readouterr().err
    assert (tmp_path / "run.mcap").read_bytes() == b"precious"


@pytest.mark.slow
def test_the_web_viewer_ends_by_a_signal_and_the_other_file_is_whole(drive, tmp_path) -> None:  # noqa: F811
    words = [drive, "--split", "test", "--rerun", "web:19787", "--mcap", tmp_path / "a.mcap"]
    command = [sys.executable, "-u", "-m", "manyeyes.cli.main", "view", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stderr
        lines = iter(process.stdout.readline, "")
        assert any("All frames are logged" in line for line in lines), process.stderr.read()
        process.send_signal(signal.SIGTERM)
        rest, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0 and "a.mcap: 3 frames" in rest
    assert len(foxglove.read(tmp_path / "a.mcap")["/truth"]) == 3
