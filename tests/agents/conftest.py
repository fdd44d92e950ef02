# SPDX-License-Identifier: Apache-2.0
"""A drive made of arithmetic: eight cars that keep their velocities and agents that drive among them, at 10 Hz."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch

from manyeyes.datatypes import AgentFrame, BevGrid, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.maps.bev import BevConfig
from manyeyes.models.maps.head import MapHeadConfig
from manyeyes.models.maps.map_model import MapModel, MapModelConfig
from manyeyes.training.detector.samples import AugmentConfig, DegradationConfig, make_sample
from manyeyes.training.detector.step import forward

TENTH_NS = 100_000_000


@dataclass(frozen=True)
class Drive:
    """Every agent sees every car whole and some ground; world: where all this is."""

    agents: int = 3
    speed_mps: float = 8.0
    agent_mps: float = 5.0
    world: Transform = Transform.from_xyz_yaw(1234.5, -678.9, 3.0, 0.4)

    def cars(self, index: int) -> Boxes:
        """In the frame that ``world`` places."""
        rng = torch.Generator().manual_seed(3)
        center = torch.cat(((torch.rand(8, 2, generator=rng) - 0.5) * 36, torch.full((8, 1), 0.8)), 1).double()
        yaw = (torch.rand(8, generator=rng).double() - 0.5) * 2 * math.pi
        velocity = self.speed_mps * torch.stack((yaw.cos(), yaw.sin()), 1)
        size = torch.tensor([4.5, 1.9, 1.6]).double().repeat(8, 1)
        return Boxes.of(center, size, yaw, id=torch.arange(8) + 100, velocity=velocity).after(0.1 * index)

    def points(self, index: int) -> torch.Tensor:
        """Surfaces of the cars, and ground, in the frame that ``world`` places."""
        rng, boxes = torch.Generator().manual_seed(4 + index), self.cars(index)
        surface = torch.rand(8, 120, 3, generator=rng).double() - 0.5
        face = torch.randint(0, 3, (8, 120, 1), generator=rng)
        surface.scatter_(2, face, surface.gather(2, face).sign() * 0.5)
        local = surface * boxes.size[:, None]
        c, s = boxes.yaw.cos()[:, None], boxes.yaw.sin()[:, None]
        x, y = local[..., 0] * c - local[..., 1] * s, local[..., 0] * s + local[..., 1] * c
        moved = torch.stack((x, y, local[..., 2]), -1) + boxes.center[:, None]
        ground = torch.cat(((torch.rand(1500, 2, generator=rng) - 0.5) * 50, torch.zeros(1500, 1)), 1)
        return torch.cat((moved.flatten(0, 1), ground.double()))

    def frame(self, agent: int, index: int) -> AgentFrame:
        """One agent's frame; its pose has zero covariance."""
        starts = ((0.0, 0.0, 0.0, 0.0), (6.0, -3.0, 0.0, 0.7), (-9.0, 4.0, 0.2, -2.0), (3.0, 9.0, 0.0, 2.0))
        x, y, z, yaw = starts[agent]
        ahead = 0.1 * index * self.agent_mps
        pose = Transform.from_xyz_yaw(x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), z, yaw)
        cloud = PointCloud.of(pose.inverse().apply(self.points(index)))
        return AgentFrame.of(cloud, self.world @ pose, agent_id=agent, timestamp_ns=index * TENTH_NS)

    def frames(self, index: int = 3) -> list[AgentFrame]:
        """All agents at one instant."""
        return [self.frame(agent, index) for agent in range(self.agents)]

    def snapshot(self, index: int) -> Snapshot:
        """All agents and the truth, in the world."""
        frames = tuple(self.frames(index))
        boxes = self.cars(index).transform(self.world)
        seen = torch.ones(self.agents, len(boxes), dtype=torch.bool)
        truth = GroundTruth(boxes, seen, Transform.stack([frame.world_from_agent for frame in frames]))
        return Snapshot("drive", index, frames, truth)


@pytest.fixture(scope="session")
def drive() -> type[Drive]:
    return Drive


def tiny_detector() -> Detector:
    """Tiny weights with calibrated norms and little pruning; layers that start at zero are random, those of the refinement too."""
    torch.manual_seed(0)
    model = Detector(replace(COSTR_TINY, prune_threshold=0.08))
    moments, road = (
        [Drive().snapshot(i) for i in range(4)],
        DegradationConfig(ego_history=2, delay_prob=0.5, max_delay_frames=2),
    )
    sample = make_sample(moments, 0, COSTR_TINY.grid, AugmentConfig.none(), ("norms",), road)
    fusion = model.fusion
    with torch.no_grad():
        silent = (
            fusion.encoding.outer,
            fusion.encoding.temporal,
            fusion.past_attention.out,
            fusion.past_attention.ffn[2],
        )
        for linear in (*silent, fusion.merge.feature_weight, model.refine.out):
            torch.nn.init.normal_(linear.weight, std=0.1)
        for norm in (m for m in model.modules() if isinstance(m, ActiveNorm)):
            norm.momentum = 0.5
        for _ in range(5):
            forward(model, [sample], 0.0)
    model.fingerprint = b"testtest"
    return model.eval().requires_grad_(False)


@pytest.fixture(scope="session")
def detector() -> Detector:
    return tiny_detector()


TINY_MAPPER = MapModelConfig(
    BevConfig(
        BevGrid(-8.0, -8.0, -2.0, 8.0, 8.0, 4.0, pillar=0.5), channels=16, raster_channels=8, raster_blocks=(1, 1)
    ),
    BevGrid(-16.0, -8.0, -1.0, 16.0, 8.0, 1.0, pillar=1.0),
    token_channels=8,
    neck_blocks=(1, 1),
    head=MapHeadConfig(
        num_queries=6,
        num_points=5,
        channels=16,
        feedforward_channels=32,
        layers=2,
        heads=4,
        min_trace_score=0.0,
        score_threshold=0.0,
    ),
)
"""Grids of 16 m by 16 m, tiles of 32 m by 16 m; all predictions are kept."""


@pytest.fixture(scope="session")
def mapper() -> MapModel:
    """A map model with random weights."""
    torch.manual_seed(0)
    model = MapModel(TINY_MAPPER).requires_grad_(False)
    # Its norms know how features are spread, as after training; nothing else is learnt.
    for _ in range(30):
        tokens = model.extract_features(
            [PointCloud.of(torch.randn(200, 3) * torch.tensor([3.0, 3.0, 0.3])) for _ in range(2)]
        ).tokens
        model.predict_elements(model.fuse(tokens, Transform.stack([Transform.identity()] * 2), torch.tensor([0, 1]), 2))
    model.eval()
    model.fingerprint = bytes(range(8))
    return model
