# SPDX-License-Identifier: Apache-2.0
"""``manyeyes fit-codebook``: trained weights gain a codebook, in their own precision, with the command in their card."""

import pytest
import torch

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


@pytest.mark.parametrize("half", [False, True])
def test_weights_gain_a_codebook_and_keep_their_card(tmp_path, half, capsys):
    writer = Opv2vWriter(tmp_path / "data" / "train" / "a")
    for index in range(2):
        xyz = (torch.rand(500, 3, generator=torch.Generator().manual_seed(index)) - 0.5) * torch.tensor([40.0, 40, 1])
        pose = Transform.from_xyz_yaw(1.0 * index, 0)
        time_ns = index * 100_000_000
        cloud = PointCloud.of(xyz, torch.full((500,), 0.5))
        frame = AgentFrame(5, time_ns, cloud, pose, torch.zeros(3, 3))
        truth = GroundTruth(Boxes.empty(torch.float64), torch.zeros(1, 0, dtype=torch.bool), Transform.stack([pose]))
        writer.write(Snapshot("a", index, (frame,), truth))
    writer.close({})
    weights, out = tmp_path / "plain.safetensors", tmp_path / "coded.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), weights, {"steps": 7}, half)
    words = [
        "fit-codebook",
        "--weights",
        str(weights),
        "--data",
        str(tmp_path / "data"),
        "--out",
        str(out),
        "--frame-stride",
        "1",
    ]
    assert cli.main([*words, "--stages", "2"]) == 0
    assert "before entropy coding" in capsys.readouterr().out
    fitted, plain = checkpoint.load(out), checkpoint.load(weights)
    assert fitted.codebook is not None and fitted.codebook.centres.shape[0] == 2 and plain.codebook is None
    assert fitted.codebook.centres.abs().sum() > 0
    for name, value in plain.state_dict().items():
        assert torch.equal(fitted.state_dict()[name], value), name
    card = checkpoint.read_card(out)
    assert card["steps"] == 7 and card["codebook"]["tokens"] > 0 and card["codebook"]["command"]
    stored = {v.dtype for k, v in checkpoint.read_state(out).items() if k != "codebook.frequencies"}
    assert stored == {torch.float16 if half else torch.float32}
