# SPDX-License-Identifier: Apache-2.0
"""The commands on a recording in DAIR-V2X's layout, which they recognise by its folders."""

import json
import math
from pathlib import Path

import pytest
import torch
from PIL import Image

from manyeyes.agents.replay import ReplayConfig
from manyeyes.cli import main as cli
from manyeyes.datasets.dair_v2x import DairRecording
from manyeyes.datasets.dair_v2x.writer import DairWriter, write_dair_index
from manyeyes.datasets.opv2v import Opv2vRecording, Opv2vWriter
from manyeyes.datasets.registry import open_recording
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.studies.recordings import adapt_to_dataset
from manyeyes.studies.replay_options import ReplayOptions


def street(index: int, later_ns: int = 0) -> Snapshot:
    """A car and a pole 15 m apart see the ground and one parked car between them."""
    rng = torch.Generator().manual_seed(index)
    poses = [Transform.from_xyz_yaw(1.0 * index, 0, 0, 0.1), Transform.from_xyz_yaw(15, 4, 0, 3.0)]
    parked = Transform.from_xyz_yaw(8, 5, 0, 0.4)
    half = torch.tensor([2.3, 0.95, 0.8])
    frames = []
    for id, pose in zip((5, -1), poses):
        ground = (torch.rand(1500, 3, generator=rng) - 0.5) * torch.tensor([50.0, 50.0, 0.02])
        body = (torch.rand(200, 3, generator=rng) * 2 - 1) * half + torch.tensor([0.0, 0.0, 0.8])
        cloud = PointCloud.of(torch.cat((ground, (pose.inverse() @ parked).apply(body))))
        time_ns = index * 100_000_000 + later_ns
        frames.append(AgentFrame(id, time_ns, cloud, pose, torch.zeros(3, 3), is_infrastructure=id < 0))
    center = torch.tensor([[8, 5, 0.8]], dtype=torch.float64)
    boxes = Boxes.of(center, 2 * half[None].double(), torch.tensor([0.4]).double(), id=torch.tensor([9]))
    truth = GroundTruth(boxes, torch.ones(2, 1, dtype=torch.bool), Transform.stack(poses))
    return Snapshot("street", index, tuple(frames), truth)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of two pairs; the pole's sweep is 20 ms the later one."""
    root = tmp_path_factory.mktemp("dair")
    drives = []
    for batch in range(2):
        writer = DairWriter(root, str(batch))
        for index in range(2):
            writer.write(street(index), 2 * batch + index, street(index, 20_000_000))
        drives.append(writer.rows)
    write_dair_index(root, drives, {"test": [id for rows in drives for id in rows.frames]})
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), path, {})
    return path


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


def test_the_layout_is_known_by_its_folders(data: Path, tmp_path: Path) -> None:
    assert isinstance(open_recording(data, "test"), DairRecording)
    Opv2vWriter(tmp_path / "drive").write(street(0))
    assert isinstance(open_recording(tmp_path), Opv2vRecording)


def test_an_ego_waits_for_the_later_sweep_of_a_pair(data: Path, tmp_path: Path) -> None:
    recording = open_recording(data)
    for playing, wait_s in (
        (ReplayOptions(), 0.05),
        (ReplayOptions(channel="its-g5"), 0.05),
        (ReplayOptions(latency_budget_ms=7.0), 0.007),
    ):
        config = adapt_to_dataset(playing.make_replay_config(0), playing, recording)
        assert (config.latency_budget_s, config.comm_range_m) == (wait_s, math.inf)
    Opv2vWriter(tmp_path / "drive").write(street(0))
    config = ReplayOptions().make_replay_config(0)
    assert adapt_to_dataset(config, ReplayOptions(), open_recording(tmp_path)) == config


def test_a_replay_takes_the_range_and_budget_of_a_reader(data: Path, tmp_path: Path) -> None:
    adapted = ReplayConfig(comm_range_m=1.0).adapt_to(open_recording(data, "test"))
    assert (adapted.comm_range_m, adapted.latency_budget_s) == (math.inf, 0.05)
    Opv2vWriter(tmp_path / "drive").write(street(0))
    assert ReplayConfig(comm_range_m=1.0).adapt_to(open_recording(tmp_path)).comm_range_m == 1.0


def test_evaluate_scores_pairs_with_infrastructure_messages(data: Path, weights: Path, tmp_path: Path) -> None:
    words = ("--methods", "none", "late", "early", "--protocol", "dair", "--workers", 1, "--timing-frames", 0)
    assert run("evaluate", "--data", data, "--split", "test", "--weights", weights, *words, "--out", tmp_path) == 0
    held = json.loads((tmp_path / "results.json").read_text())["result"]
    assert [n["ap_summaries"][0]["n_gt"] for n in held["stats"]] == [4, 4, 4]
    early = held["stats"][2]
    assert early["communication"]["bytes_per_message"] > 0
    assert early["age_ms"] == pytest.approx(30, abs=5), (
        "received within the latency budget of 50 ms, 20 ms after the vehicle's sweep"
    )


def test_run_and_view_take_the_layout(data: Path, weights: Path, tmp_path: Path) -> None:
    words = ("--weights", weights, "--methods", "early", "--out", tmp_path / "run")
    assert run("replay", data, "--scenario", "1", *words) == 0
    assert {"early.png", "report.html", "results.json"} <= {p.name for p in (tmp_path / "run").iterdir()}
    assert run("view", data, "--split", "test", "--width", 480, "--out", tmp_path / "frame.png") == 0
    with Image.open(tmp_path / "frame.png") as image:
        assert image.width == 480


def test_an_unknown_split_is_one_line(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("view", data, "--split", "val", "--out", tmp_path / "x.png") == 1
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 1 and "no split 'val'; it has test" in output[0]
