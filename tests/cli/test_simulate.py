# SPDX-License-Identifier: Apache-2.0
"""``manyeyes simulate`` into a folder that is not empty: it continues its own run, and refuses to change anything else."""

import hashlib
import json
import resource
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("libsumo", reason="scenarios need the sim extra")

from manyeyes._io import atomic_write
from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.simulator import presets, record
from manyeyes.simulator.presets import SIMULATION_PRESETS, SimulationPreset, SplitPreset

SMALL = SimulationPreset(
    (SplitPreset("test", ("generated-1",), 2),), frames=2, history_frames=1, vehicles=(2, 2), min_vehicles=4
)


@pytest.fixture(scope="module", autouse=True)
def small_presets():
    """Presets of two scenarios of two frames each, by names of the command line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SIMULATION_PRESETS, "small", SMALL)
        patch.setitem(SIMULATION_PRESETS, "smaller", replace(SMALL, splits=(SplitPreset("test", ("generated-1",), 1),)))
        stand_in = replace(SMALL, splits=(SplitPreset("test", ("Town10HD",), 2),), fallback_town="generated-1")
        patch.setitem(SIMULATION_PRESETS, "stand-in", stand_in)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, small_presets: None) -> Path:
    root = tmp_path_factory.mktemp("made") / "small"
    assert simulate(root) == 0
    return root


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "small"))


def simulate(out: Path, *words: object, preset: str = "small") -> int:
    return cli.main(["simulate", "--preset", preset, "--out", str(out), "--workers", "1", *map(str, words)])


def hashes(root: Path) -> dict[str, str]:
    """SHA-256 of every file but the log of the last command."""
    found = (p for p in sorted(root.rglob("*")) if p.is_file() and p.name != "simulate.json")
    return {p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in found}


def refused(root: Path, capsys: pytest.CaptureFixture[str], *words: object, preset: str = "small") -> str:
    """The one line of the error; every file is as it was."""
    before = hashes(root) | {"log": (root / "simulate.json").read_text() if (root / "simulate.json").is_file() else ""}
    capsys.readouterr()
    assert simulate(root, *words, preset=preset) == 1
    after = hashes(root) | {"log": (root / "simulate.json").read_text() if (root / "simulate.json").is_file() else ""}
    assert after == before
    (line,) = capsys.readouterr().err.splitlines()
    assert "othing was changed" in line
    return line


@pytest.mark.slow
def test_the_same_settings_keep_a_finished_folder(folder: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file() and p.name != "simulate.json"}
    assert simulate(folder) == 0
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert json.loads((folder / "simulate.json").read_text())["result"]["scenarios"] == 2


def test_splits_are_added_one_by_one_and_are_those_of_a_whole_run(tmp_path: Path, monkeypatch, capsys) -> None:
    two = (SplitPreset("train", ("generated-1",), 1), SplitPreset("test", ("generated-2",), 1))
    monkeypatch.setitem(SIMULATION_PRESETS, "two", replace(SMALL, splits=two))
    assert simulate(tmp_path / "parts", "--splits", "test", preset="two") == 0
    manifest = json.loads((tmp_path / "parts" / "manifest.json").read_text())
    assert {entry["split"] for entry in manifest["scenarios"]} == {"test"}
    assert not (tmp_path / "parts" / "train").exists()
    assert simulate(tmp_path / "parts", "--splits", "train", preset="two") == 0
    assert simulate(tmp_path / "whole", preset="two") == 0
    assert hashes(tmp_path / "parts") == hashes(tmp_path / "whole")
    assert "no split 'tset'; choose from train, test" in refused_split(tmp_path / "parts", capsys, "tset", "two")
    monkeypatch.setitem(SIMULATION_PRESETS, "numbered", replace(SMALL, layout="dair", vehicles=(1, 1)))
    assert "numbers the frames of all splits together" in refused_split(tmp_path / "dair", capsys, "test", "numbered")
    assert not (tmp_path / "dair").exists()


def refused_split(out: Path, capsys: pytest.CaptureFixture[str], split: str, preset: str) -> str:
    """The one line of the error; nothing was changed."""
    before = hashes(out) if out.is_dir() else {}
    capsys.readouterr()
    assert simulate(out, "--splits", split, preset=preset) == 1
    assert (hashes(out) if out.is_dir() else {}) == before
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_another_seed_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(folder, capsys, "--seed", 1)
    assert "2 finished scenarios of preset 'small', seed 0" in line and "preset 'small', seed 1" in line
    assert "choose another --out, or remove the folder yourself" in line


@pytest.mark.parametrize(
    ("preset", "words", "message"),
    [
        ("smaller", (), "preset 'smaller'"),
        ("smoke-opv2v", (), "preset 'smoke-opv2v'"),
        ("smoke-dair", (), "layout of DAIR-V2X"),
        ("small", ("--cameras",), "cameras 'none' instead of 'opv2v-small'"),
    ],
)
def test_other_settings_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], preset: str, words: tuple[str, ...], message: str
) -> None:
    assert message in refused(folder, capsys, *words, preset=preset)


def test_a_run_without_a_manifest_is_refused_by_its_specifications(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "manifest.json").unlink()
    assert "seed" in refused(folder, capsys, "--seed", 1)


def forget_specification(folder: Path) -> None:
    (folder / "test" / "generated-1_0001" / "scenario.json").unlink()


def add_scenario(folder: Path) -> None:
    shutil.copytree(folder / "test" / "generated-1_0001", folder / "train" / "2021_08_16_22_26_54")
    (folder / "train" / "2021_08_16_22_26_54" / "scenario.json").unlink()


def add_pairs(folder: Path) -> None:
    (folder / "vehicle-side").mkdir()


@pytest.mark.parametrize(
    ("add", "manifest"),
    [
        (forget_specification, False),
        *((add, manifest) for add in (add_scenario, add_pairs) for manifest in (True, False)),
    ],
)
def test_recordings_of_others_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], add: Callable[[Path], None], manifest: bool
) -> None:
    add(folder)
    if not manifest:
        (folder / "manifest.json").unlink()
    assert "1 scenario folder that no run of 'manyeyes simulate' for this layout wrote" in refused(folder, capsys)


def test_a_manifest_of_another_tool_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text('{"files": []}')
    assert simulate(tmp_path) == 1
    assert "expected a manifest of 'manyeyes simulate'" in capsys.readouterr().err
    assert hashes(tmp_path).keys() == {"manifest.json"}


@pytest.mark.slow
@pytest.mark.parametrize("finished", [0, 1])
def test_an_interrupted_run_continues_and_is_known_by_its_seed(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], finished: int
) -> None:
    write, calls = record._write, []

    def stopped(job: object, scenario: object, partial: Path) -> int:
        calls.append(partial)
        if len(calls) > finished:
            partial.mkdir(parents=True)
            (partial / "half").write_text("")
            raise KeyboardInterrupt
        return write(job, scenario, partial)  # pyright: ignore[reportArgumentType]

    root = tmp_path / "small"
    with monkeypatch.context() as patch:
        patch.setattr(record, "_write", stopped)
        assert simulate(root) == 130
    assert not (root / "manifest.json").exists() and not (root / "simulate.json").exists()
    assert "seed 0" in refused(root, capsys, "--seed", 1)
    refused(root, capsys, "--cameras")
    kept = {p: p.stat().st_mtime_ns for p in root.glob("test/*/scenario.json")}
    assert len(kept) == finished
    assert simulate(root) == 0
    assert hashes(root) == hashes(made) and {p: p.stat().st_mtime_ns for p in kept} == kept


def test_a_failed_start_leaves_no_marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(*_: object) -> None:
        raise ConfigError("no scene")

    monkeypatch.setattr(record, "make_first_scenario", nothing)
    assert simulate(tmp_path) == 1
    assert not hashes(tmp_path)


def change_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def times(root: Path) -> dict[str, int]:
    return {p.relative_to(root).as_posix(): p.stat().st_mtime_ns for p in root.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_missing_truncated_and_altered_files_alone_are_repaired(
    made: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = folder / "test" / "generated-1_0001"
    clouds = sorted(scenario.glob("*/*.pcd"))
    damaged = (clouds[0], clouds[1], clouds[2].with_suffix(".yaml"), scenario / "data_protocol.yaml")
    for path, damage in zip(damaged, (Path.unlink, truncate, change_a_byte, Path.unlink)):
        damage(path)
    line = refused(folder, capsys)
    assert all(str(path) in line for path in damaged) and "finished scenario test/generated-1_0001" in line
    assert "add --repair to simulate these files again" in line
    before = times(folder)
    assert simulate(folder, "--repair") == 0
    assert hashes(folder) == hashes(made)
    names = {path.relative_to(folder).as_posix() for path in damaged}
    assert {name for name, time in times(folder).items() if before.get(name) != time} == names | {"simulate.json"}
    printed = capsys.readouterr().out
    assert all(f"simulated again: {path}: " in printed for path in damaged)
    assert simulate(folder) == 0


def forget_digests(scenario: Path) -> None:
    """As a version wrote it that noted the digest of all files together."""
    content = json.loads((scenario / "scenario.json").read_text())
    del content["files"]
    (scenario / "scenario.json").write_text(json.dumps(content))
    change_a_byte(min(scenario.glob("*/*.pcd")))


def lose_specification(scenario: Path) -> None:
    (scenario / "scenario.json").unlink()
    min(scenario.glob("*/*.pcd")).unlink()


def truncate_specification(scenario: Path) -> None:
    truncate(scenario / "scenario.json")


def alter_entry(scenario: Path) -> None:
    path = scenario / "scenario.json"
    path.write_text(path.read_text().replace('"sha256": "', '"sha256": "0'))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (forget_digests, "generated-1_0001: mismatched"),
        (truncate_specification, "generated-1_0001/scenario.json: mismatched"),
        (shutil.rmtree, "generated-1_0001: missing"),
    ],
)
def test_a_scenario_without_sound_digests_is_repaired_by_the_manifest(
    made: Path, folder: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None], named: str
) -> None:
    damage(folder / "test" / "generated-1_0001")
    line = refused(folder, capsys)
    assert named in line and "add --repair to simulate this file again" in line
    assert simulate(folder, "--repair") == 0
    assert hashes(folder) == hashes(made)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lose_specification, "generated-1_0001/scenario.json: missing (manifest.json lists it)"),
        (alter_entry, "generated-1_0001/scenario.json: mismatched (its entry is not that of manifest.json)"),
    ],
)
def test_a_finished_folder_is_compared_with_its_manifest(
    folder: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None], named: str
) -> None:
    damage(folder / "test" / "generated-1_0001")
    reason = named.replace(" (", " in the finished scenario test/generated-1_0001 (")
    assert reason in refused(folder, capsys)


@pytest.mark.slow
def test_a_repair_with_other_bytes_changes_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    content["scenarios"][0]["sha256"] = "0" * 64
    path.write_text(json.dumps(content))
    assert "its entry is not that of manifest.json" in refused(folder, capsys)
    assert "its files are not those of the first run" in refused(folder, capsys, "--repair")


def test_a_file_that_no_run_wrote_is_not_repaired(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stray = min(folder.glob("test/generated-1_0000/*/*.pcd")).with_name("000099.pcd")
    stray.write_bytes(b"")
    line = refused(folder, capsys, "--repair")
    assert str(stray) in line and "remove this file yourself" in line


def test_a_full_disk_leaves_no_half_written_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(job: object, scenario: object, draft: Path) -> int:
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit[1]))
        try:
            atomic_write(draft / "641" / "000000.pcd", bytes(100), durable=False)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        raise AssertionError

    monkeypatch.setattr(record, "_write", fill)
    assert simulate(tmp_path) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "641/000000.pcd: " in line and "free some space and run again" in line
    assert hashes(tmp_path).keys() == {"manifest.partial.json"}


def test_other_files_in_the_folder_change_nothing(folder: Path) -> None:
    (folder / "notes.txt").write_text("")
    (folder / "test" / "generated-1_0000" / "notes.txt").write_text("")
    assert simulate(folder) == 0


@pytest.mark.slow
def test_roads_that_are_found_later_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nowhere(name: str, path: str | None) -> Path:
        raise ConfigError(f"no {name} in {path}")

    with monkeypatch.context() as patch:
        patch.setattr(presets, "find_town", nowhere)
        assert simulate(tmp_path, preset="stand-in") == 0
        assert simulate(tmp_path, preset="stand-in") == 0
    monkeypatch.setattr(presets, "find_town", lambda name, path: tmp_path)
    line = refused(tmp_path, capsys, preset="stand-in")
    assert "test/generated-1_0000 is not one of this run, which has test/town10hd_0000" in line


def test_a_replaced_cloud_of_a_simulated_recording_is_an_error_of_evaluate(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    weights = tmp_path / "untrained.safetensors"
    checkpoint.save(Detector(COSTR_TINY), weights, {})
    words = (
        "evaluate",
        "--data",
        folder,
        "--split",
        "test",
        "--weights",
        weights,
        "--methods",
        "none",
        "--workers",
        1,
    )
    words = [str(word) for word in (*words, "--timing-frames", 0, "--out", tmp_path / "out")]
    assert cli.main(words) == 0
    one, *_, other = sorted((folder / "test" / "generated-1_0000").glob("*/000002.pcd"))
    shutil.copyfile(other, one)
    assert cli.main(words) == 1
    assert f"{one}: mismatched (its SHA-256 is not that in scenario.json)" in capsys.readouterr().err
