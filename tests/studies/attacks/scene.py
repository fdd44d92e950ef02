# SPDX-License-Identifier: Apache-2.0
"""A small recording of four agents on a road with two cars, and weights that were never trained."""

from pathlib import Path

import torch

from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

HALF = torch.tensor([2.3, 0.95, 0.8])
HISTORY_FRAMES, NUM_FRAMES, NUM_AGENTS = 2, 6, 4


def make_snapshot(scenario: str, index: int, num_agents: int = NUM_AGENTS) -> Snapshot:
    """Agents stand on a line, 12 m apart; a parked car and one that drives at 10 m/s."""
    rng = torch.Generator().manual_seed(index)
    poses = [Transform.from_xyz_yaw(12.0 * k, 0.5 * k, 0, 0.1 * k) for k in range(num_agents)]
    cars = [Transform.from_xyz_yaw(8, 5, 0, 0.4), Transform.from_xyz_yaw(4 + index, -5, 0, 0.0)]
    frames = []
    for k, pose in enumerate(poses):
        parts = [(torch.rand(400, 3, generator=rng) - 0.5) * torch.tensor([50.0, 50.0, 0.02])]
        for car in cars:
            body = (torch.rand(100, 3, generator=rng) * 2 - 1) * HALF + torch.tensor([0.0, 0.0, 0.8])
            parts.append((pose.inverse() @ car).apply(body))
        xyz = torch.cat(parts).float()
        cloud = PointCloud.of(xyz, torch.full((len(xyz),), 0.5))
        frames.append(AgentFrame(5 + k, index * 100_000_000, cloud, pose, torch.zeros(3, 3)))
    center = torch.tensor([[8, 5, 0.8], [4 + index, -5, 0.8]], dtype=torch.float64)
    yaw, velocity = torch.tensor([0.4, 0.0]).double(), torch.tensor([[0.0, 0.0], [10.0, 0.0]]).double()
    boxes = Boxes.of(center, (2 * HALF).double().expand(2, 3), yaw, id=torch.tensor([90, 91]), velocity=velocity)
    seen = torch.ones(num_agents, 2, dtype=torch.bool)
    return Snapshot(scenario, index, tuple(frames), GroundTruth(boxes, seen, Transform.stack(poses)))


def write_recording(root: Path) -> Path:
    for name in ("a", "b"):
        writer = Opv2vWriter(root / "test" / name)
        for index in range(NUM_FRAMES):
            snapshot = make_snapshot(name, index)
            assert snapshot.truth is not None
            writer.write(snapshot, snapshot.truth.boxes.velocity.norm(dim=1))
        writer.close({"history_frames": HISTORY_FRAMES})
    return root


def make_detector() -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Detector(COSTR_TINY).eval()


def write_weights(path: Path) -> Path:
    checkpoint.save(make_detector(), path, {"steps": 7, "seed": 3, "command": "manyeyes train"})
    return path
