# SPDX-License-Identifier: Apache-2.0
"""The command train with FeaKM's presets: views are kept once and shared, the run resumes, the weights load."""

import json
from pathlib import Path

import pytest
import torch

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.pose import feakm

pytestmark = pytest.mark.training


def snapshot(index: int) -> Snapshot:
    """Two agents 10 m apart among 100 points each."""
    frames = []
    for agent in (3, 5):
        rng = torch.Generator().manual_seed(agent + index)
        xyz = (torch.rand(100, 3, generator=rng) - 0.5) * torch.tensor([40.0, 40.0, 2.0])
        pose = Transform.from_xyz_yaw(5.0 * agent, 0, 0, 0.1 * agent)
        frames.append(AgentFrame.of(PointCloud.of(xyz), pose, agent, 100_000_000 * index))
    boxes = Boxes.of(
        torch.tensor([[20.0, 5, 0.8]]).double(),
        torch.ones(1, 3).double(),
        torch.zeros(1).double(),
        id=torch.tensor([9]),
    )
    poses = Transform.stack([f.world_from_agent for f in frames])
    return Snapshot("a", index, tuple(frames), GroundTruth(boxes, torch.ones(2, 1, dtype=torch.bool), poses))


@pytest.fixture
def words(tmp_path, monkeypatch) -> list[str]:
    writer = Opv2vWriter(tmp_path / "data" / "train" / "a")
    for index in range(2):
        writer.write(snapshot(index))
    writer.close({"history_frames": 1})
    torch.manual_seed(0)
    checkpoint.save(Detector(COSTR_TINY), tmp_path / "detector.safetensors", {})
    monkeypatch.chdir(tmp_path)
    return ["train", "--data", "data", "--weights", "detector.safetensors", "--batch", "1", "--preset"]


def test_both_presets_train_on_the_same_kept_views(words, capsys):
    assert cli.main([*words, "feakm-small", "--steps", "2", "--out", "small"]) == 0
    assert "weights.safetensors; the loss over steps" in capsys.readouterr().out.replace("\n", "")
    made = {p.name for p in Path("small").iterdir()}
    assert made == {"weights.safetensors", "last.pt", "log.jsonl", "loss.png", "train.json"}
    net = feakm.load(Path("small/weights.safetensors"))
    detector = checkpoint.load(Path("detector.safetensors"))
    assert net.config.detector == detector.fingerprint.hex() and net.config.keypoints.in_channels == 32
    card = checkpoint.read_card(Path("small/weights.safetensors"), feakm.FORMAT)
    assert card["steps"] == 2 and card["command"]
    kept = {p: p.stat().st_mtime_ns for p in Path("runs/views").rglob("*.safetensors")}
    assert len(kept) == 1 and detector.fingerprint.hex() in str(next(iter(kept)))
    before = Path("small/log.jsonl").read_text()
    assert cli.main([*words, "feakm-small", "--steps", "2", "--out", "small"]) == 0
    assert Path("small/log.jsonl").read_text() == before
    assert kept == {p: p.stat().st_mtime_ns for p in Path("runs/views").rglob("*.safetensors")}
    assert json.loads(Path("small/train.json").read_text())["result"]["weights"] == "weights.safetensors"
    assert cli.main([*words, "feakm-small", "--steps", "3", "--out", "small"]) == 1
    assert "steps is 2 there and 3 here" in capsys.readouterr().err


def test_an_unknown_preset_lists_these_too(words, capsys):
    assert cli.main([*words, "moon"]) == 1
    assert "costr-small" in (output := capsys.readouterr().err) and "feakm-paper" in output
