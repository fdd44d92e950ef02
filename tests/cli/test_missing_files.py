# SPDX-License-Identifier: Apache-2.0
"""Files that a recording lacks, or that are another's, by the command line: an error, or counted in JSON and under the table."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from manyeyes.cli import main as cli
from manyeyes.datasets.dair_v2x.writer import DairWriter, write_dair_index
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

CARS = ((8, 5, 0.4), (18, -6, 1.5), (-9, 4, 0.1), (17, 8, -0.3), (1, 9, 2.2), (2, -8, 0.9))
HALF = torch.tensor([2.3, 0.95, 0.8])
FOOTER = "1 file missing or mismatched: the ground truth and all rows are affected; see results.json."


def street(scenario: str, index: int, ids: tuple[int, ...] = (5, 7, -1)) -> Snapshot:
    """Agents 15 m apart see the ground and six parked cars; each cloud has points of its own."""
    rng = torch.Generator().manual_seed(index + 100 * len(scenario))
    poses = [Transform.from_xyz_yaw(15.0 * k + index, 4.0 * k, 0, 0.1 + 1.1 * k) for k in range(len(ids))]
    parked = [Transform.from_xyz_yaw(x, y, 0, yaw) for x, y, yaw in CARS]
    frames = []
    for id, pose in zip(ids, poses):
        parts = [(torch.rand(300, 3, generator=rng) - 0.5) * torch.tensor([100.0, 100.0, 0.02])]
        for car in parked:
            body = (torch.rand(40, 3, generator=rng) * 2 - 1) * HALF + torch.tensor([0.0, 0.0, 0.8])
            parts.append((pose.inverse() @ car).apply(body))
        cloud = PointCloud.of(torch.cat(parts))
        frames.append(AgentFrame(id, index * 100_000_000, cloud, pose, torch.zeros(3, 3), is_infrastructure=id < 0))
    x, y, yaw = torch.tensor(CARS, dtype=torch.float64).unbind(-1)
    boxes = Boxes.of(
        torch.stack((x, y, torch.full_like(x, 0.8)), -1),
        (2 * HALF).double().expand(len(CARS), 3),
        yaw,
        id=torch.arange(50, 50 + len(CARS)),
    )
    seen = torch.ones(len(ids), len(CARS), dtype=torch.bool)
    return Snapshot(scenario, index, tuple(frames), GroundTruth(boxes, seen, Transform.stack(poses)))


def note_digests(folder: Path, each_file: bool) -> None:
    """Write scenario.json as 'manyeyes simulate' does; older versions noted no digest of each file."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    digests = {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    total = hashlib.sha256("\n".join(f"{digest}  {name}" for name, digest in digests.items()).encode()).hexdigest()
    entry = {"files": len(files), "bytes": sum(p.stat().st_size for p in files), "sha256": total}
    content = {"spec": {}, "entry": entry} | ({"files": digests} if each_file else {})
    (folder / "scenario.json").write_text(json.dumps(content))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole")
    for name in ("a", "bb"):
        writer = Opv2vWriter(root / "test" / name)
        for index in range(3):
            writer.write(street(name, index))
        writer.close({"history_frames": 1})
    return root


@pytest.fixture(params=["without digests", "a total digest", "a digest of each file"])
def data(whole: Path, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy to damage: as another tool writes a recording, and as the simulator's versions do."""
    monkeypatch.setenv("GLOBAL_SORT_CACHE", str(tmp_path / "cache"))
    shutil.copytree(whole, tmp_path / "data")
    if request.param != "without digests":
        for folder in (tmp_path / "data" / "test").iterdir():
            note_digests(folder, request.param == "a digest of each file")
    return tmp_path / "data"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {})
    return path


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


def evaluate(data: Path, weights: Path, out: Path, *words: object) -> int:
    common = (
        "--split",
        "test",
        "--weights",
        weights,
        "--workers",
        1,
        "--timing-frames",
        0,
        "--methods",
        "none",
        "early",
    )
    return run("evaluate", "--data", data, *common, "--out", out, *words)


def no_record_of_the_ego(root: Path) -> Path:
    path = root / "test" / "a" / "5" / "000002.yaml"
    path.unlink()
    return path


def no_cloud_of_another_agent(root: Path) -> Path:
    path = root / "test" / "bb" / "7" / "000004.pcd"
    path.unlink()
    return path


def cloud_of_another_agent(root: Path) -> Path:
    path = root / "test" / "a" / "5" / "000002.pcd"
    shutil.copyfile(path.parent.parent / "7" / "000002.pcd", path)
    return path


def cloud_of_another_frame(root: Path) -> Path:
    path = root / "test" / "a" / "5" / "000004.pcd"
    shutil.copyfile(path.with_name("000002.pcd"), path)
    return path


def cloud_of_another_scenario(root: Path) -> Path:
    path = root / "test" / "a" / "5" / "000002.pcd"
    shutil.copyfile(root / "test" / "bb" / "7" / "000004.pcd", path)
    return path


def record_of_another_agent(root: Path) -> Path:
    path = root / "test" / "a" / "7" / "000002.yaml"
    shutil.copyfile(path.parent.parent / "5" / "000002.yaml", path)
    return path


DAMAGES = (
    no_record_of_the_ego,
    no_cloud_of_another_agent,
    cloud_of_another_agent,
    cloud_of_another_frame,
    cloud_of_another_scenario,
    record_of_another_agent,
)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_missing_or_replaced_file_is_one_line_and_no_result(
    data: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[Path], Path]
) -> None:
    path = damage(data)
    assert evaluate(data, weights, tmp_path / "out") == 1
    (output,) = capsys.readouterr().err.splitlines()
    assert f"{path.parent.name}/{path.stem}" in output and "--allow-missing" in output
    assert not (tmp_path / "out").exists()


def test_allowed_files_are_counted_in_json_and_footers(
    data: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = no_record_of_the_ego(data)
    assert evaluate(data, weights, tmp_path, "--allow-missing") == 0
    held = json.loads((tmp_path / "results.json").read_text())["result"]
    assert held["missing"]["count"] == 1
    (file,) = held["missing"]["files"]
    assert (file["path"], file["kind"], file["scenario"]) == (str(path), "missing", "a")
    # One of four evaluated frames is absent, and with it a quarter of the true boxes.
    assert [n["ap_summaries"][0]["n_gt"] for n in held["stats"]] == [18, 18]
    assert FOOTER in capsys.readouterr().out and FOOTER in (tmp_path / "results.md").read_text()


def test_an_allowed_replaced_cloud_is_counted(data: Path, weights: Path, tmp_path: Path) -> None:
    path = cloud_of_another_agent(data)
    assert evaluate(data, weights, tmp_path, "--allow-missing") == 0
    missing = json.loads((tmp_path / "results.json").read_text())["result"]["missing"]
    assert [(f["path"], f["kind"]) for f in missing["files"]] == [(str(path), "mismatched")]


@pytest.mark.parametrize("again", [False, True])
def test_a_whole_recording_has_no_footer(
    data: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], again: bool
) -> None:
    for _ in range(1 + again):
        assert evaluate(data, weights, tmp_path) == 0
    held = json.loads((tmp_path / "results.json").read_text())["result"]
    assert held["missing"] == {"count": 0, "files": []}
    assert [n["ap_summaries"][0]["n_gt"] for n in held["stats"]] == [24, 24]
    assert "missing" not in capsys.readouterr().out + (tmp_path / "results.md").read_text()


def test_a_replaced_file_is_noticed_after_a_sound_verdict_was_kept(data: Path, weights: Path, tmp_path: Path) -> None:
    assert evaluate(data, weights, tmp_path) == 0
    cloud_of_another_frame(data)
    assert evaluate(data, weights, tmp_path) == 1


@pytest.mark.slow
def test_many_files_are_counted_and_the_list_is_capped(
    whole: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = Opv2vWriter(tmp_path / "data" / "long")
    for index in range(60):
        writer.write(street("long", index, (5, 7)))
    shutil.rmtree(tmp_path / "data" / "long" / "7")
    (tmp_path / "data" / "long" / "7").mkdir()
    words = ("evaluate", "--data", tmp_path / "data", "--weights", weights, "--methods", "none", "--frame-stride", 30)
    words = (*words, "--workers", 1, "--timing-frames", 0, "--out", tmp_path)
    assert run(*words) == 1
    assert "long/7/000000.pcd: missing (other agents have the frame), and 119 more" in capsys.readouterr().err
    assert run(*words, "--allow-missing") == 0
    missing = json.loads((tmp_path / "results.json").read_text())["result"]["missing"]
    assert missing["count"] == 120 and len(missing["files"]) == 100
    assert "120 files missing or mismatched" in capsys.readouterr().out


def run_pose(data: Path, weights: Path, out: Path) -> tuple[object, ...]:
    return ("pose", data, "--split", "test", "--weights", weights, "--correctors", "identity", "--out", out)


def run_replay(data: Path, weights: Path, out: Path) -> tuple[object, ...]:
    words = (
        "replay",
        data,
        "--split",
        "test",
        "--weights",
        weights,
        "--methods",
        "none",
        "--out",
        out,
        "--min-score",
        0.9,
    )
    return (*words, "--no-animate")


def run_fit_codebook(data: Path, weights: Path, out: Path) -> tuple[object, ...]:
    words = (
        "fit-codebook",
        "--data",
        data,
        "--split",
        "test",
        "--weights",
        weights,
        "--out",
        out / "coded.safetensors",
    )
    return (*words, "--stages", 1, "--frame-stride", 1)


def run_study(data: Path, weights: Path, out: Path) -> tuple[object, ...]:
    words = ("study", "num-agents", "--data", data, "--split", "test", "--weights", weights, "--workers", 1)
    return (*words, "--methods", "none", "late", "--frame-stride", 2, "--out", out)


def run_train(data: Path, weights: Path, out: Path) -> tuple[object, ...]:
    words = ("train", "--data", data, "--split", "test", "--preset", "costr-tiny", "--steps", 1, "--batch", 1)
    return (*words, "--out", out)


def missing_in(path: str) -> Callable[[Path], dict]:
    return lambda out: json.loads((out / path).read_text())["result"]["missing"]


def missing_in_card(out: Path) -> dict:
    return checkpoint.read_card(out / "coded.safetensors")["codebook"]["missing"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "held"),
    [
        (run_pose, missing_in("pose.json")),
        (run_replay, missing_in("results.json")),
        (run_fit_codebook, missing_in_card),
        (run_study, missing_in("num-agents.json")),
        (run_train, missing_in("train.json")),
    ],
)
def test_every_command_refuses_and_counts(
    whole: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: Callable[..., tuple],
    held: Callable[[Path], dict],
) -> None:
    data, out = shutil.copytree(whole, tmp_path / "data"), tmp_path / "out"
    out.mkdir()
    path = no_record_of_the_ego(data)
    words = command(data, weights, out)
    assert run(*words) == 1
    assert str(path) in capsys.readouterr().err and not any(out.iterdir())
    assert run(*words, "--allow-missing") == 0
    assert held(out)["count"] == 1
    if command is not run_fit_codebook:
        assert "1 file missing or mismatched" in capsys.readouterr().out


def test_a_study_of_the_map_model_refuses_before_it_loads_weights(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    path = no_record_of_the_ego(data)
    assert run("study", "local", "--data", data, "--weights", "none", "--out", tmp_path / "o") == 1
    output = capsys.readouterr().err
    assert str(path) in output and "--allow-missing" in output and not (tmp_path / "o").exists()


def test_the_report_of_a_drive_has_the_footer(whole: Path, weights: Path, tmp_path: Path) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    no_record_of_the_ego(data)
    assert run(*run_replay(data, weights, tmp_path), "--allow-missing") == 0
    assert FOOTER in (tmp_path / "report.html").read_text() and FOOTER in (tmp_path / "results.md").read_text()


def test_a_drive_is_played_whatever_other_scenarios_lack(whole: Path, weights: Path, tmp_path: Path) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    no_record_of_the_ego(data)
    assert run(*run_replay(data, weights, tmp_path), "--scenario", "bb") == 0
    assert run(*run_replay(data, weights, tmp_path), "--scenario", "a") == 1


@pytest.mark.slow
def test_cells_of_an_incomplete_recording_are_kept_apart(whole: Path, weights: Path, tmp_path: Path) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    path = data / "test" / "a" / "7" / "000004.yaml"  # behind the first evaluated frame, which alone names a cell
    text = path.read_text()
    path.unlink()
    words = (*run_study(data, weights, tmp_path / "out"), "--frame-stride", 1)
    assert run(*words, "--allow-missing") == 0
    damaged = json.loads((tmp_path / "out" / "num-agents.json").read_text())["result"]
    path.write_text(text)
    assert run(*words) == 0
    whole_one = json.loads((tmp_path / "out" / "num-agents.json").read_text())["result"]
    assert (damaged["missing"]["count"], whole_one["missing"]["count"]) == (1, 0)
    assert damaged["rows"][-1]["mean_snapshot_bytes"] < whole_one["rows"][-1]["mean_snapshot_bytes"]


def test_view_stays_tolerant(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    no_record_of_the_ego(data)
    assert run("view", data, "--split", "test", "--width", 480, "--out", tmp_path / "frame.png") == 0
    assert "note: " in capsys.readouterr().out


def test_an_absent_scenario_of_the_manifest_is_missing(
    whole: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(whole, tmp_path / "data")
    listed = [{"split": "test", "name": name} for name in ("a", "bb", "ccc")]
    (data / "manifest.json").write_text(json.dumps({"format": "OPV2V", "settings": {}, "scenarios": listed}))
    assert evaluate(data, weights, tmp_path / "out") == 1
    assert "test/ccc: missing (the recording's manifest lists this scenario)" in capsys.readouterr().err
    shutil.copytree(data / "test" / "a", data / "test" / "ccc.partial")
    assert evaluate(data, weights, tmp_path / "out") == 1
    assert (
        "ccc.partial: missing (an interrupted run of 'manyeyes simulate' left it unfinished)" in capsys.readouterr().err
    )
    assert evaluate(data / "test" / "a", weights, tmp_path / "out", "--split", "None") == 0


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    root, drives = tmp_path / "dair", []
    for batch in range(2):
        writer = DairWriter(root, str(batch))
        for index in range(2):
            writer.write(street("p" * (batch + 1), index, (5, -1)), 2 * batch + index)
        drives.append(writer.rows)
        digests = {p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in writer.files}
        content = {"rows": asdict(writer.rows), "entry": {"files": 0, "bytes": 0, "sha256": ""}, "files": digests}
        (root / "batches").mkdir(exist_ok=True)
        (root / "batches" / f"{batch:06d}.json").write_text(json.dumps(content))
    write_dair_index(root, drives, {"test": [id for rows in drives for id in rows.frames]})
    return root


def no_cloud(root: Path) -> Path:
    path = root / "infrastructure-side" / "velodyne" / "000001.pcd"
    path.unlink()
    return path


def no_label(root: Path) -> Path:
    path = root / "cooperative" / "label_world" / "000002.json"
    path.unlink()
    return path


def other_cloud(root: Path) -> Path:
    path = root / "vehicle-side" / "velodyne" / "000001.pcd"
    shutil.copyfile(path.with_name("000000.pcd"), path)
    return path


@pytest.mark.parametrize("digests", [False, True])
@pytest.mark.parametrize("damage", [no_cloud, no_label, other_cloud])
def test_pairs_of_dair_v2x_are_checked_alike(
    pairs: Path,
    weights: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[Path], Path],
    digests: bool,
) -> None:
    if not digests:
        shutil.rmtree(pairs / "batches")
    assert evaluate(pairs, weights, tmp_path / "out") == 0
    assert json.loads((tmp_path / "out" / "results.json").read_text())["result"]["missing"]["count"] == 0
    path = damage(pairs)
    assert evaluate(pairs, weights, tmp_path / "out") == 1
    output = capsys.readouterr().err
    assert str(path) in output and "--allow-missing" in output
    if damage is not no_label:  # without its truth no pair is evaluated, allowed or not
        assert evaluate(pairs, weights, tmp_path / "out", "--allow-missing") == 0
        assert json.loads((tmp_path / "out" / "results.json").read_text())["result"]["missing"]["count"] == 1
