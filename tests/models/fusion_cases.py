# SPDX-License-Identifier: Apache-2.0
"""Rows and tokens for tests of fusion rules: agents on cells that are given by hand, or drawn."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, Transform
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows, gather_by_cell, standing_cells
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens, to_ego_frame

GRID = BevGrid(-25.6, -25.6, -3.0, 25.6, 25.6, 5.0).at(4)
CHANNELS = 16
CONFIG = AttentionConfig(window=4, heads=2)


def agent(features: Tensor, yx: Tensor, sender: bool, roadside: bool = False, heat: float = -9.0) -> AgentTokens:
    """An agent at the ego's pose with tokens (n, C) on cells (n, 2); a sender is another agent than the ego."""
    proposal = torch.zeros(len(features), PROPOSAL_DIM)
    proposal[:, 0] = heat
    motion = Transform.identity() if sender else None
    rows = torch.cat((features, proposal), 1)
    return AgentTokens(0, rows, GRID.centers(yx), motion, is_infrastructure=roadside)


def draw_agent(seed: int, sender: bool, n: int = 40, reach: int = 10, roadside: bool = False) -> AgentTokens:
    """An agent with drawn features on drawn cells, reach cells around the middle."""
    g = torch.Generator().manual_seed(seed)
    cell = torch.randperm((2 * reach) ** 2, generator=g)[:n]
    yx = torch.stack((cell // (2 * reach), cell % (2 * reach)), 1) + GRID.shape[0] // 2 - reach
    drawn = agent(torch.randn(n, CHANNELS, generator=g), yx, sender, roadside)
    drawn.tokens[:, CHANNELS] = torch.randn(n, generator=g)
    return drawn


def tokens_of(*agents: AgentTokens, batch_size: int = 1) -> Tokens:
    return to_ego_frame(agents, GRID, batch_size)


def rows_of(*agents: AgentTokens) -> CellRows:
    tokens = tokens_of(*agents)
    return gather_by_cell(tokens.features, tokens, standing_cells(tokens))[0]


def at(*columns: int) -> Tensor:
    """Cells (n, 2) of one row of the grid, three cells apart, so that no convolution connects two of them."""
    return torch.tensor([[16, 4 + 3 * column] for column in columns]).view(-1, 2)


def built(rule: type[nn.Module], absent: AbsentSenders = "masked") -> nn.Module:
    torch.manual_seed(0)
    return rule(CHANNELS, CONFIG, absent).eval().requires_grad_(False)
