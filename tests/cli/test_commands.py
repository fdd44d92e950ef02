# SPDX-License-Identifier: Apache-2.0
"""The commands on a small recording with untrained weights: every file is written, every error is one line."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


def street(scenario: str, index: int) -> Snapshot:
    """A car and a pole 15 m apart see the ground and one parked car between them."""
    rng = torch.Generator().manual_seed(index)
    poses = [Transform.from_xyz_yaw(1.0 * index, 0, 0, 0.1), Transform.from_xyz_yaw(15, 4, 0, 3.0)]
    parked = Transform.from_xyz_yaw(8, 5, 0, 0.4)
    half = torch.tensor([2.3, 0.95, 0.8])
    frames = []
    for id, pose in zip((5, -1), poses):
        ground = (torch.rand(1500, 3, generator=rng) - 0.5) * torch.tensor([50.0, 50.0, 0.02])
        body = (torch.rand(200, 3, generator=rng) * 2 - 1) * half + torch.tensor([0.0, 0.0, 0.8])
        xyz = torch.cat((ground, (pose.inverse() @ parked).apply(body)))
        time_ns = index * 100_000_000
        cloud = PointCloud.of(xyz, torch.full((len(xyz),), 0.5))
        frames.append(AgentFrame(id, time_ns, cloud, pose, torch.zeros(3, 3), is_infrastructure=id < 0))
    center = torch.tensor([[8, 5, 0.8]], dtype=torch.float64)
    boxes = Boxes.of(center, 2 * half[None].double(), torch.tensor([0.4]).double(), id=torch.tensor([9]))
    return Snapshot(
        scenario, index, tuple(frames), GroundTruth(boxes, torch.ones(2, 1, dtype=torch.bool), Transform.stack(poses))
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("data")
    for name in ("a", "b"):
        writer = Opv2vWriter(root / "test" / name)
        for index in range(3):
            writer.write(street(name, index))
        writer.close({"history_frames": 1})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {})
    return path


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


@pytest.mark.slow
def test_run_writes_table_pictures_animation_report_and_json(data, weights, tmp_path, capsys) -> None:
    assert run("replay", data, "--split", "test", "--weights", weights, "--out", tmp_path, "--min-score", 0.9) == 0
    output = capsys.readouterr()
    assert all(name in output.out for name in ("no-fusion", "late", "intermediate", "early", "report.html"))
    made = {p.name for p in tmp_path.iterdir()}
    pictures = {f"{name}.png" for name in ("no-fusion", "late", "intermediate", "early")}
    assert made == pictures | {"reliability.png", "drive.gif", "report.html", "results.json", "results.md"}
    held = json.loads((tmp_path / "results.json").read_text())
    assert [n["method"] for n in held["result"]["stats"]] == ["no-fusion", "late", "intermediate", "early"]
    assert held["provenance"]["config"]["detector"]["pillar_channels"] == COSTR_TINY.pillar_channels
    sent = {n["method"]: n["communication"]["bytes_per_message"] for n in held["result"]["stats"]}
    assert sent["no-fusion"] is None and 0 < sent["late"] < sent["early"]
    assert all(n["ap_summaries"][0]["n_gt"] == 2 for n in held["result"]["stats"])
    with Image.open(tmp_path / "drive.gif") as film:
        assert film.n_frames == 2
    report = (tmp_path / "report.html").read_text()
    # A picture of each method for browsers without scripts, and the reliability diagram; the player replaces the animation.
    assert report.count("data:image/png") == 5 and report.count("data:image/") == 5
    assert re.search(r'"methods":\[\{"name":"no-fusion".*"name":"early"', report)
    assert " --split test --scenario " in report


@pytest.mark.slow
def test_two_runs_agree_except_for_times(data, weights, tmp_path) -> None:
    results = []
    for name, workers in (("one", 1), ("two", 2)):
        words = ("--workers", workers, "--timing-frames", 0, "--out", tmp_path / name)
        assert run("evaluate", "--data", data, "--split", "test", "--weights", weights, *words) == 0
        results.append(json.loads((tmp_path / name / "results.json").read_text())["result"])
    assert results[0] == results[1]
    assert (tmp_path / "one" / "results.md").read_text() == (tmp_path / "two" / "results.md").read_text()


def test_evaluate_compares_methods_over_scenarios(data, weights, tmp_path, capsys) -> None:
    words = ("--methods", "no-fusion", "intermediate", "--workers", 1, "--out", tmp_path)
    assert run("evaluate", "--data", data, "--split", "test", "--weights", weights, *words) == 0
    assert "intermediate - no-fusion" in capsys.readouterr().out
    held = json.loads((tmp_path / "results.json").read_text())["result"]
    page = (tmp_path / "report.html").read_text()
    assert "intermediate - no-fusion" in page and '"player":null' in page and '"label":"intermediate"' in page
    (half, seven) = held["differences"]
    assert (half["metric"], seven["metric"]) == ("AP@0.5", "AP@0.7")
    assert half["description"] == "intermediate - no-fusion" and half["interval"]["num_scenarios"] == 2
    assert held["rows"][1]["perceive_ms"] > 0


@pytest.mark.parametrize("name", ["frame.png", "drive.gif", "drive.webp"])
def test_view_draws_a_frame_or_a_drive(data, tmp_path, name) -> None:
    assert run("view", data, "--split", "test", "--width", 480, "--out", tmp_path / name) == 0
    with Image.open(tmp_path / name) as image:
        assert image.width == 480 and getattr(image, "n_frames", 1) == (1 if name.endswith("png") else 2)


def test_view_with_detections_differs_from_view_without(data, weights, tmp_path) -> None:
    common = ("view", data, "--split", "test", "--half-extent-m", 25.6, 25.6, "--width", 480)
    assert run(*common, "--out", tmp_path / "without.png") == 0
    words = ("--detect", "intermediate", "--weights", weights, "--min-score", 0.0)
    assert run(*common, *words, "--out", tmp_path / "with.png") == 0
    assert (tmp_path / "with.png").read_bytes() != (tmp_path / "without.png").read_bytes()


def broken(data: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    shutil.copytree(data / "test" / "a", tmp_path / "broken" / "a")
    return tmp_path / "broken"


def spoil_nothing(folder: Path) -> None:
    shutil.rmtree(folder)


def spoil_cloud(folder: Path) -> None:
    path = sorted(folder.glob("a/5/*.pcd"))[1]
    path.write_bytes(path.read_bytes()[:-100])


def spoil_pose(folder: Path) -> None:
    path = sorted(folder.glob("a/5/*.yaml"))[1]
    path.write_text(path.read_text().replace("lidar_pose", "somewhere"))


def spoil_points(folder: Path) -> None:
    path = sorted(folder.glob("a/5/*.pcd"))[1]
    content = path.read_bytes()
    start = content.index(b"DATA binary\n") + len(b"DATA binary\n")
    path.write_bytes(content[:start] + b"\x00\x00\xc0\x7f" + content[start + 4 :])


@pytest.mark.parametrize(
    ("spoil", "named"),
    [(spoil_nothing, "no such folder"), (spoil_cloud, ".pcd"), (spoil_pose, "lidar_pose"), (spoil_points, "NaN")],
)
def test_a_spoilt_recording_is_one_line_that_names_the_thing(data, weights, tmp_path, capsys, spoil, named) -> None:
    folder = broken(data, tmp_path)
    spoil(folder)
    assert run("replay", folder, "--weights", weights, "--out", tmp_path / "out") == 1
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and output[0].startswith("manyeyes: ") and named in output[0] and "broken" in output[0]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("simulate", "--preset", "moon"), ("moon", "carla-towns-small")),
        (("train", "--data", ".", "--preset", "moon"), ("moon", "costr-small")),
        (("replay", ".", "--channel", "smoke"), ("smoke", "its-g5")),
        (("replay", ".", "--methods", "guess"), ("guess", "intermediate")),
        (("demo", "--weights", "moon"), ("moon", ".safetensors")),
        (("evaluate", "--data", ".", "--protocol", "moon"), ("moon", "opencood")),
        (("view", ".", "--out", "film.mp4"), ("film.mp4", ".gif")),
    ],
)
def test_an_unknown_name_is_one_line_that_lists_the_known(words, named, capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*words) == 1
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and all(name in output[0] for name in named)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_scenario_or_frame_lists_the_known(data, weights, tmp_path, capsys) -> None:
    common = ("replay", data, "--split", "test", "--weights", weights, "--out", tmp_path)
    assert run(*common, "--scenario", "z") == 1
    assert "it has a, b" in capsys.readouterr().err
    assert run(*common, "--frame", 0) == 1
    assert "1 to 2" in capsys.readouterr().err
    assert run("view", data, "--split", "test", "--frame", 99, "--out", tmp_path / "x.png") == 1
    assert "has no frame 99; choose one of 0 to 2." in capsys.readouterr().err


def test_weights_of_another_shape_are_one_line(data, weights, tmp_path, capsys) -> None:
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(weights, "pt") as file:
        state, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    name = sorted(n for n, v in state.items() if v.dim() == 2)[0]
    state[name] = state[name][:, :-1].contiguous()
    save_file(state, tmp_path / "other.safetensors", metadata)
    assert (
        run("replay", data, "--split", "test", "--weights", tmp_path / "other.safetensors", "--out", tmp_path / "o")
        == 1
    )
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and name in output[0] and "other.safetensors" in output[0]


@pytest.mark.slow
def test_train_writes_weights_log_picture_and_json(data, tmp_path, capsys) -> None:
    words = ("--preset", "costr-tiny", "--steps", 2, "--batch", 1, "--out", tmp_path / "run")
    assert run("train", "--data", data, "--split", "test", *words) == 0
    made = {p.name for p in (tmp_path / "run").iterdir()}
    assert made == {"weights.safetensors", "last.pt", "log.jsonl", "loss.png", "train.json"}
    card = checkpoint.read_card(tmp_path / "run" / "weights.safetensors")
    assert card["steps"] == 2 and card["seed"] == 0 and "versions" in card and "command" in card
    assert len((tmp_path / "run" / "log.jsonl").read_text().splitlines()) == 2


@pytest.mark.slow
@pytest.mark.training
def test_train_runs_a_plan_on_a_mixture_and_goes_on_with_it(data, tmp_path) -> None:
    out = tmp_path / "run"
    words = ("--preset", "costr-tiny/plan", "--steps", 1, "--batch", 1, "--seed", 4, "--out", out)
    command = ("train", "--data", data, data, "--split", "test", "--data-weights", 2, 1, *words)
    assert run(*command) == 0
    assert {p.name for p in out.iterdir()} == {"stage1", "stage2", "codebook", "weights.safetensors", "train.json"}
    assert {p.name for p in (out / "stage2").iterdir()} >= {"weights.safetensors", "log.jsonl", "loss.png"}
    card = checkpoint.read_card(out / "weights.safetensors")
    assert [stage["seed"] for stage in card["stages"]] == [4, 5] and card["codebook"]["seed"] == 6
    assert (card["preset"], card["data"]) == ("costr-tiny/plan", [str(data), str(data)])
    before = checkpoint.load(out / "weights.safetensors").fingerprint
    assert run(*command) == 0
    assert checkpoint.load(out / "weights.safetensors").fingerprint == before


@pytest.mark.slow
def test_calibrate_adds_maps_and_keeps_the_weights(data, weights, tmp_path, capsys) -> None:
    out = tmp_path / "calibrated.safetensors"
    words = ("--weights", weights, "--data", data, "--split", "test", "--max-frames", 2)
    assert run("calibrate", *words, "--out", out) == 0
    assert "fused: " in capsys.readouterr().out
    before, after = checkpoint.load(weights), checkpoint.load(out)
    assert after.fingerprint == before.fingerprint and before.score_calibration is None
    assert after.score_calibration is not None and after.score_calibration.fused is not None
    card = checkpoint.read_card(out)
    assert card["calibrated_on"]["command"] and set(card["calibrated_on"]["boxes"]) == {"own", "late", "early", "fused"}
    assert run("calibrate", *words[:1], out, *words[2:], "--out", out) == 0
    assert checkpoint.load(out).score_calibration == after.score_calibration


@pytest.mark.slow
@pytest.mark.training
def test_finetune_prints_the_holdout_before_and_after(data, weights, tmp_path, capsys) -> None:
    words = ("--data", data, "--split", "test", "--weights", weights, "--steps", 1, "--out", tmp_path)
    assert run("finetune", *words, "--validation", data, "--validation-split", "test") == 0
    output = capsys.readouterr().out
    assert "4 held out; 1 steps" in output and "after - before" in output and "minutes of CPU time" in output
    result = json.loads((tmp_path / "finetune.json").read_text())["result"]
    assert [(row["weights"], row["method"]) for row in result["rows"]] == [
        (when, method) for when in ("before", "after") for method in ("no-fusion", "intermediate-temporal")
    ]
    tuned = checkpoint.load(tmp_path / "weights.safetensors")
    assert tuned.codebook is not None and tuned.score_calibration is not None
    assert checkpoint.read_card(tmp_path / "weights.safetensors")["finetuned_from"] == str(weights)


@pytest.mark.slow
@pytest.mark.training
def test_finetune_adds_a_class_and_compares_the_classes_of_both(data, weights, tmp_path, capsys) -> None:
    words = (
        "--data",
        data,
        "--split",
        "test",
        "--weights",
        weights,
        "--out",
        tmp_path,
        "--steps",
        1,
        "--max-frames",
        2,
    )
    words += ("--validation", data, "--validation-split", "test", "--classes", "vehicle", "pedestrian")
    assert run("finetune", *words) == 0
    capsys.readouterr()
    assert checkpoint.load(tmp_path / "weights.safetensors").config.classes == ("vehicle", "pedestrian")
    result = json.loads((tmp_path / "finetune.json").read_text())["result"]
    found = [(row["weights"], row["class_name"]) for row in result["rows"]]
    assert {("before", "vehicle"), ("after", "vehicle"), ("after", "pedestrian")} == set(found)
    assert len(result["comparisons"]) == 2 * found.count(("after", "vehicle"))


def test_finetune_refuses_a_recording_that_is_too_short_for_a_holdout(data, weights, tmp_path, capsys) -> None:
    assert run("finetune", "--data", data / "test" / "a", "--weights", weights, "--out", tmp_path) == 1
    assert "too few for a holdout" in capsys.readouterr().err


def test_train_needs_one_weight_a_recording(data, capsys) -> None:
    assert run("train", "--data", data, data, "--data-weights", 1, "--split", "test") == 1
    assert "A mixture of 2 recordings needs 2 positive weights; got [1.0]" in capsys.readouterr().err


def test_the_recording_of_the_tests_round_trips(data) -> None:
    recording = Opv2vRecording(data, "test", use_cache=False)
    assert recording.eval_indices("a") == range(1, 3) and recording.agents("a") == (5, -1)
