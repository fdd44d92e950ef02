# SPDX-License-Identifier: Apache-2.0
"""Where2comm's fusion (Hu et al., NeurIPS 2022): attention of the ego's row over agents, weighted by the confidence of each agent.

The selection of what is sent is the strategy ``intermediate-where2comm``. The paper fuses three scales; here it is the scale of the
tokens.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule
from manyeyes.ops.window_attention import sincos_encoding


@register_rule("where2comm")
class Where2comm(nn.Module):
    """Multi-head attention over the senders of a cell, residual, norm, two linear layers, residual, norm.

    The weight of each sender is multiplied by its confidence on the cell. Keys hold the position in the sender's own frame, in
    cells, which states the distance to its sensor. renormalise: weights add up to one again after that, unlike in the paper.
    An absent sender, where it is a row of zeros, has confidence zero: it takes part in the softmax alone.
    """

    sends_confidence = True

    def __init__(
        self, channels: int, attention: AttentionConfig, absent: AbsentSenders, renormalise: bool = False
    ) -> None:
        super().__init__()
        self.absent, self.heads, self.renormalise = absent, attention.heads, renormalise
        self.query, self.key, self.value, self.out = (nn.Linear(channels, channels) for _ in range(4))
        self.norm, self.norm_ffn = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.ffn = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        x, own = rows.features, rows.own_features()
        place = sincos_encoding(rows.sender_xy / rows.sites.grid.cell_size_m, x.shape[1])
        query, key, value = self._split(self.query(own)), self._split(self.key(x + place)), self._split(self.value(x))
        scale = 1 / math.sqrt(query.shape[2])
        logit = (query[rows.cell] * key).sum(2) * scale
        absent_logit = None
        if self.absent == "zero":
            absent_logit = (query * self.key.bias.view(self.heads, -1)).sum(2) * scale
        weight = rows.softmax(logit, absent_logit) * rows.confidence[:, None]
        if self.renormalise:
            weight = weight / rows.sum(weight)[rows.cell].clamp_min(torch.finfo(weight.dtype).tiny)
        attended = self.out(rows.sum((weight[:, :, None] * value).flatten(1)))
        fused = self.norm(own + attended)
        return self.norm_ffn(fused + self.ffn(fused))

    def _split(self, x: Tensor) -> Tensor:
        return x.view(len(x), self.heads, x.shape[1] // self.heads)
