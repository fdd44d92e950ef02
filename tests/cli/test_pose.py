# SPDX-License-Identifier: Apache-2.0
"""The command pose on a street of parked cars that two agents detect, with a detector of known output."""

import json
import math
from types import SimpleNamespace

import pytest
import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.pose.registry import POSE_CORRECTORS, RegisteredCorrector
from manyeyes.pose.types import no_estimate

PLACES = [
    (8, 5, 0.4),
    (20, -6, 1.5),
    (-9, 4, 0.1),
    (30, 8, -0.3),
    (14, 16, 2.2),
    (2, -14, 0.9),
    (25, -18, -1.0),
    (-4, 21, 0.2),
]
POSES = [Transform.from_xyz_yaw(0, 0, 0, 0.1), Transform.from_xyz_yaw(15, 4, 0, 3.0)]


def cars():
    n = len(PLACES)
    x, y, yaw = torch.tensor(PLACES, dtype=torch.float64).unbind(-1)
    size = torch.tensor([[4.5, 1.9, 1.6]], dtype=torch.float64).repeat(n, 1)
    return Boxes.of(torch.stack((x, y, torch.full_like(x, 0.8)), -1), size, yaw, id=torch.arange(100, 100 + n))


@pytest.fixture
def drive(tmp_path, monkeypatch):
    writer = Opv2vWriter(tmp_path / "data" / "test" / "a")
    for index in range(2):
        cloud = PointCloud.of(torch.zeros(10, 3), torch.zeros(10))
        time_ns = index * 100_000_000
        frames = tuple(
            AgentFrame(i, time_ns, cloud, pose, torch.zeros(3, 3), is_infrastructure=i < 0)
            for i, pose in zip((5, -1), POSES)
        )
        truth = GroundTruth(cars(), torch.ones(2, len(PLACES), dtype=torch.bool), Transform.stack(POSES))
        writer.write(Snapshot("a", index, frames, truth))
    writer.close({"history_frames": 0})
    path = tmp_path / "untrained.safetensors"
    checkpoint.save(Detector(COSTR_TINY), path, {})

    def process(self, frame):
        return SimpleNamespace(boxes=cars().transform(POSES[0 if frame.agent_id == 5 else 1].inverse()))

    monkeypatch.setattr(PerceptionCache, "process", process)
    return tmp_path / "data", path, tmp_path


def run(*words):
    return cli.main(list(map(str, words)))


def test_an_unknown_pose_is_found_and_a_noisy_prior_improved(drive, capsys) -> None:
    data, weights, out = drive
    noise = ("--noise-xy-m", 0.4, "--noise-yaw-deg", 0.4)
    assert (
        run("pose", data, "--split", "test", "--weights", weights, "--out", out, "--no-prior", "--correctors", "voting")
        == 0
    )
    assert run("pose", data, "--split", "test", "--weights", weights, "--out", out / "noisy", *noise) == 0
    output = capsys.readouterr().out
    assert (
        "voting" in output
        and "identity" in output
        and "pose.json" in output
        and "agent -1: prior pose sound over 2 frames" in output
    )
    free, noisy = (json.loads((p / "pose.json").read_text())["result"] for p in (out, out / "noisy"))
    for estimate in free["estimates"]:
        assert (
            estimate["status"] == "corrected"
            and estimate["inliers"] == len(PLACES)
            and estimate["common"] == len(PLACES)
        )
        assert estimate["error_m"] < 1e-3
    scores = noisy["scores"]
    assert scores["voting"]["mean_displacement_m"] < scores["identity"]["mean_displacement_m"] and math.isfinite(
        scores["voting"]["nees"]
    )


def test_whole_clouds_are_compared_by_name(drive, monkeypatch) -> None:
    data, weights, out = drive
    sizes = []

    def cloud(ego, other, prior):
        sizes.append((len(ego), len(other)))
        return no_estimate(prior)

    POSE_CORRECTORS.get("scan-registration")
    monkeypatch.setitem(POSE_CORRECTORS._items, "scan-registration", RegisteredCorrector(cloud, "clouds"))
    words = ("--split", "test", "--weights", weights, "--out", out, "--correctors", "scan-registration", "voting")
    assert run("pose", data, *words) == 0
    estimates = json.loads((out / "pose.json").read_text())["result"]["estimates"]
    assert [a["corrector"] for a in estimates] == ["scan-registration", "voting"] * len(sizes) and len(sizes) > 0
    assert [tuple(a["landmarks"]) for a in estimates[::2]] == sizes and estimates[0]["status"] == "no match"


def test_an_unknown_corrector_lists_the_known(drive, capsys) -> None:
    data, weights, out = drive
    assert run("pose", data, "--split", "test", "--weights", weights, "--out", out, "--correctors", "magic") == 1
    assert "known: clipper, coalign, feaco, feakm, fpv-rcnn" in capsys.readouterr().err
