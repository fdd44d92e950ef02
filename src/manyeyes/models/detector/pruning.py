# SPDX-License-Identifier: Apache-2.0
"""Focal pruning (CoSTr section III-B): drop cells that do not belong to an object."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from manyeyes.datatypes import Sites, SparseBev


@dataclass(frozen=True)
class PruneOutput:
    """Input of one pruning layer: its sites and the logit (N,) of each being near an object."""

    sites: Sites
    logit: Tensor


class FocalPrune(nn.Module):
    """One logit per cell, trained with focal loss on whether the cell's centre lies near a box; keeps cells above a
    threshold.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.score = nn.Linear(channels, 1)
        nn.init.constant_(self.score.bias, -2.19)

    def forward(self, x: SparseBev, threshold: float) -> tuple[SparseBev, PruneOutput]:
        """Keep the cells whose probability exceeds threshold (0 keeps all); returns them and the logits of all cells."""
        logit = self.score(x.features)[:, 0]
        pruned = PruneOutput(x.sites, logit)
        if threshold <= 0:
            return x, pruned
        return x.keep(torch.sigmoid(logit.detach()) > threshold), pruned
