# SPDX-License-Identifier: Apache-2.0
"""Focal pruning (CoSTr section III-B): drop the cells that cannot belong to an object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from manyeyes.datatypes import Sites, SparseBev


@dataclass(frozen=True)
class PruneOutput:
    """What one pruning layer saw: its sites before pruning and the logit (N,) of each lying near an object."""

    sites: Sites
    logit: Tensor


class FocalPrune(nn.Module):
    """A logit a cell, trained with focal loss on whether the cell's centre lies near a box; keeps logits above a threshold."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.score = nn.Linear(channels, 1)
        nn.init.constant_(self.score.bias, -2.19)

    def forward(self, x: SparseBev, threshold: float) -> tuple[SparseBev, PruneOutput]:
        """Cells whose probability exceeds threshold (0 keeps all), as a new set, and what was decided on."""
        logit = self.score(x.features)[:, 0]
        pruned = PruneOutput(x.sites, logit)
        if threshold <= 0:
            return x, pruned
        return x.keep(torch.sigmoid(logit.detach()) > threshold), pruned
