# SPDX-License-Identifier: Apache-2.0
"""Shipped weights agree with their manifest; a missing, truncated or altered file is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from manyeyes.datatypes import CheckpointError
from manyeyes.models.shipped import MANIFEST, check_weights, describe_weights, read_manifest

WEIGHTS = Path(__file__).resolve().parents[2] / "src" / "manyeyes" / "models" / "weights"
NAME = "map-small-lidar"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of weights with one file and its entry."""
    shutil.copy(WEIGHTS / f"{NAME}.safetensors", tmp_path)
    entry = next(line for line in (WEIGHTS / MANIFEST).read_text().splitlines() if NAME in line)
    (tmp_path / MANIFEST).write_text(f"[{entry.rstrip(',')}]")
    return tmp_path


def test_the_manifest_describes_every_file_of_the_package() -> None:
    files = sorted(WEIGHTS.glob("*.safetensors"))
    assert read_manifest(WEIGHTS) == tuple(describe_weights(file) for file in files)


def test_every_model_card_has_weights_and_names_no_other_fingerprint() -> None:
    entries = {entry.name: entry for entry in read_manifest(WEIGHTS)}
    assert {card.stem for card in WEIGHTS.glob("*.md")} == set(entries)
    assert f"fingerprint {entries['costr-small'].fingerprint}" in (WEIGHTS / "feakm-small.md").read_text()


def test_whole_weights_have_no_problem(folder: Path) -> None:
    (status,) = check_weights(folder)
    assert (status.name, status.problem) == (NAME, "") and len(status.fingerprint) == 16


def test_a_truncated_file_is_named(folder: Path) -> None:
    path = folder / f"{NAME}.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])
    (status,) = check_weights(folder)
    assert str(path) in status.problem and "bytes instead of" in status.problem


def test_an_altered_file_of_the_same_size_is_named(folder: Path) -> None:
    path = folder / f"{NAME}.safetensors"
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    (status,) = check_weights(folder)
    assert str(path) in status.problem and "SHA-256" in status.problem


def test_a_file_that_does_not_load_is_named(folder: Path) -> None:
    path = folder / f"{NAME}.safetensors"
    path.write_bytes(bytes(path.stat().st_size))
    (status,) = check_weights(folder)
    assert str(path) in status.problem and status.fingerprint == ""


def test_missing_and_unlisted_files_are_named(folder: Path) -> None:
    (folder / f"{NAME}.safetensors").rename(folder / "map-other.safetensors")
    missing, unlisted = sorted(check_weights(folder), key=lambda status: status.name != NAME)
    assert "No such file" in missing.problem and "not in manifest.json" in unlisted.problem


@pytest.mark.parametrize("content", ["", "[1]", '[{"name": "x"}]'])
def test_a_damaged_manifest_is_an_error_that_names_it(folder: Path, content: str) -> None:
    (folder / MANIFEST).write_text(content)
    with pytest.raises(CheckpointError, match=r"manifest\.json: expected a list of weights"):
        check_weights(folder)
