# SPDX-License-Identifier: Apache-2.0
"""Which parameters a method uses: those that are counted, and no others, change its boxes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from manyeyes.agents.agent import Agent
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.datatypes import AgentFrame, PointCloud, Transform
from manyeyes.evaluation.detection.model_size import WITHOUT_TOKEN_FUSION, ModelSize, count_parameters
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY


def make_frame(agent: int, index: int) -> AgentFrame:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(10 * agent + index))
    cloud = PointCloud.of((points - 0.5) * torch.tensor([20.0, 20.0, 2.0]), torch.full((300,), 0.5))
    pose = Transform.from_xyz_yaw(4.0 * agent + index, 0, 0, 0.0)
    return AgentFrame(agent, index * 100_000_000, cloud, pose, torch.zeros(3, 3))


def perceive(detector: Detector, method: str) -> Tensor:
    """Scores and places of the boxes of one agent that receives from another, at the second of two instants."""
    ego, other = (Agent(detector, get_strategy(method), "float32") for _ in range(2))
    for index in (0, 1):
        boxes = ego.perceive(make_frame(0, index), other.share(make_frame(1, index))).boxes
    return torch.cat((boxes.center, boxes.score[:, None]), 1)


@pytest.mark.slow
@pytest.mark.parametrize("method", [m for m in list_strategies() if m.partition("-")[0] in ("no", "late", "early")])
def test_methods_without_token_fusion_are_the_same_with_other_fusion_weights(method: str) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        detector = Detector(COSTR_TINY).eval()
        before = perceive(detector, method)
        for module in (detector.fusion, detector.refine):
            for parameter in module.parameters():
                torch.nn.init.normal_(parameter, std=1.0)
    after = perceive(detector, method)
    assert len(before) > 0
    is_same = before.shape == after.shape and bool((before == after).all())
    assert is_same == (method in WITHOUT_TOKEN_FUSION)


def test_a_detector_without_parameters_has_no_size() -> None:
    assert count_parameters(object(), "late") == ModelSize(None, None)  # pyright: ignore[reportArgumentType]


def test_intermediate_fusion_uses_the_whole_model() -> None:
    detector = Detector(COSTR_TINY)
    whole = sum(p.numel() for p in detector.parameters())
    size = count_parameters(detector, "intermediate")
    assert size == ModelSize(sum(p.numel() for p in detector.fusion.parameters()), whole) and size.fusion
