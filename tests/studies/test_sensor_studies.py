# SPDX-License-Identifier: Apache-2.0
"""The studies sensors and strata from end to end on small recordings, with weights that were never trained."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from tests.studies.test_detection_studies import crossing

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Data sets beams-16 and beams-32 of the same scenes; beams-16 has two splits."""
    root = tmp_path_factory.mktemp("data")
    for data, split in (("beams-16", "test"), ("beams-16", "town-2"), ("beams-32", "test")):
        writer = Opv2vWriter(root / data / split / "a")
        for index in range(3):
            snapshot = crossing("a", index, 2)
            writer.write(snapshot, snapshot.truth.boxes.velocity.norm(dim=1))
        writer.close({"history_frames": 1})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {})
    return path


def run(root: Path, weights: Path, out: Path, study: str, *words: object) -> int:
    common = ("--data", root / "beams-16", "--weights", weights, "--workers", 1, "--out", out)
    return cli.main([str(word) for word in ("study", study, *common, *words)])


@pytest.mark.slow
def test_sensors_has_a_row_for_each_recording_change_and_method(root, weights, tmp_path) -> None:
    words = (
        "--split",
        "test",
        "--other-data",
        root / "beams-32",
        "--laws",
        "material",
        "zero",
        "--methods",
        "no-fusion",
    )
    assert run(root, weights, tmp_path, "sensors", *words, "intermediate", "--tilts-deg", 0, 1.5) == 0
    result = json.loads((tmp_path / "sensors.json").read_text())["result"]
    rows = result["rows"]
    expected = {
        (recording, law, sweeps, tilt, method)
        for recording in ("beams-16", "beams-32")
        for law in ("material", "zero")
        for sweeps in (1, 2)
        for tilt in (0.0, 1.5)
        for method in ("no-fusion", "intermediate")
    }
    named = {(r["recording"], r["law"], r["sweeps"], r["tilt_deg"], r["method"]) for r in rows}
    assert named == expected and len(rows) == len(expected)
    # Both recordings hold the same clouds.
    by_key = {(r["recording"], r["law"], r["sweeps"], r["tilt_deg"], r["method"]): r["ap"][0]["value"] for r in rows}
    assert all(value == by_key[("beams-32", *key[1:])] for key, value in by_key.items())
    assert all(r["below_best"]["value"] <= 0 for r in rows)
    assert {"Sensors, no-fusion", "Sensors, intermediate"} <= {
        line.removeprefix("## ") for line in (tmp_path / "sensors.md").read_text().splitlines()
    }
    assert (tmp_path / "sensors.png").exists() and result["comparisons"]


@pytest.mark.slow
def test_strata_are_reported_apart(root, weights, tmp_path) -> None:
    assert run(root, weights, tmp_path, "strata", "--methods", "no-fusion", "intermediate") == 0
    result = json.loads((tmp_path / "strata.json").read_text())["result"]
    assert [(r["stratum"], r["method"]) for r in result["rows"]] == [
        (stratum, method) for stratum in ("test", "town-2") for method in ("no-fusion", "intermediate")
    ]
    assert [c["description"] for c in result["comparisons"]][::2] == [
        "intermediate - no-fusion, test",
        "intermediate - no-fusion, town-2",
    ]


def test_wrong_names_are_refused(root, weights, tmp_path, capsys) -> None:
    for study, words, text in (
        ("sensors", ("--split", "test", "--laws", "paint"), "No intensity law 'paint'; choose one of material, carla"),
        ("sensors", ("--split", "test", "--other-data", root / "beams-16"), "names recordings by folder, each once"),
        ("strata", ("--split", "test"), "takes --strata instead of --split"),
    ):
        assert run(root, weights, tmp_path, study, *words) == 1
        assert text in capsys.readouterr().err
    empty = tmp_path / "beams-16"
    empty.mkdir()
    assert run(tmp_path, weights, tmp_path / "out", "strata") == 1
    assert "no folder of a split" in capsys.readouterr().err
    shutil.rmtree(empty)
