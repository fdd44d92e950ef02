# SPDX-License-Identifier: Apache-2.0
"""DiscoNet (Li et al., NeurIPS 2021): one learned weight an agent and cell, a softmax over agents, and the weighted sum.

The fused features are distilled from a network on merged clouds (``training.detector.distillation``).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from manyeyes.models.detector.layers import ActiveNorm
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule

WIDTHS = (128, 32, 8)
"""Hidden channels of the network that weighs agents."""


@register_rule("disconet")
class DiscoNet(nn.Module):
    """y = sum_j softmax_j(ReLU(phi([x_j ; x_0]))) x_j over the senders j of a cell; the ego's row x_0 is zero where it has none."""

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.absent: AbsentSenders = absent
        widths = (2 * channels, *WIDTHS)
        layers = [(nn.Linear(a, b), ActiveNorm(b), nn.ReLU()) for a, b in pairwise(widths)]
        self.weigh = nn.Sequential(*(part for layer in layers for part in layer), nn.Linear(widths[-1], 1), nn.ReLU())

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        x, own = rows.features, rows.own_features()
        pairs = torch.cat((x, own[rows.cell]), 1)
        if self.absent == "masked":
            return rows.sum(rows.softmax(self.weigh(pairs)) * x)
        # Absent senders have rows of zeros, and weights of their own.
        logit = self.weigh(torch.cat((pairs, torch.cat((torch.zeros_like(own), own), 1))))
        return rows.sum(rows.softmax(logit[: len(x)], logit[len(x) :]) * x)
