# SPDX-License-Identifier: Apache-2.0
"""Bring a method of your own: a fusion module that is trained, and a strategy that selects what is sent."""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from manyeyes import AgentFrame, FusionStrategy, benchmark, open_recording, register_fusion, register_strategy
from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.replay import WARMUP_FRAMES, ReplayConfig
from manyeyes.agents.strategies.intermediate import IntermediateFusion
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat, proposed_velocity
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.voxelize import segment_mean
from manyeyes.simulator.presets import simulate
from manyeyes.training.detector.presets import DETECTOR_TRAINING_PRESETS
from manyeyes.training.detector.task import DetectorTask
from manyeyes.training.trainer import Trainer


@register_fusion("mean")
class MeanFusion(nn.Module):
    """Mean of the features of all agents in a cell; boxes are merged as in the other fusion modules."""

    def __init__(self, channels: int, attention: AttentionConfig) -> None:
        super().__init__()
        self.merge = TokenMerge(channels, "max")

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        key, cell_offset = assign_cells(tokens)
        merged = self.merge(tokens.features, tokens, key, cell_offset)
        row = torch.searchsorted(merged.bev.sites.key, key)
        mean = segment_mean(tokens.features, row, len(merged.bev.sites))
        return FusedBev(merged.bev.with_features(mean), merged.merged_proposals)


def score_moving(cache: PerceptionCache, frame: AgentFrame) -> Tensor:
    """Score (N,) of tokens: the confidence of an object, times its speed; a budget keeps the highest."""
    proposals = cache.process_tokens(frame).shared_tokens.features[:, -PROPOSAL_DIM:]
    return torch.sigmoid(proposed_heat(proposals)) * (1 + proposed_velocity(proposals).norm(dim=1))


@register_strategy("moving-first")
def moving_first() -> FusionStrategy:
    return IntermediateFusion(score=score_moving)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "drive"
    if not folder.exists():
        simulate("smoke-opv2v", folder)
    preset = DETECTOR_TRAINING_PRESETS["costr-tiny"]
    config = replace(preset, detector=replace(preset.detector, fusion="mean"), steps=5)  # a real one takes thousands
    weights = Trainer(DetectorTask(config, open_recording(folder, "train")), folder.parent / "run").run()
    replay = ReplayConfig(budget_bytes=1000, warmup_frames=WARMUP_FRAMES)  # of a message: some of the tokens
    print(benchmark(open_recording(folder, "test"), weights, ["intermediate", "moving-first"], replay=replay))
