# SPDX-License-Identifier: Apache-2.0
"""AttFuse (Xu et al., OPV2V, ICRA 2022): scaled dot-product self-attention over agents at every cell; the ego's row is the result.

It has no weights of its own. The paper fuses three scales of the backbone; here it is the scale of the tokens.
"""

from __future__ import annotations

import math

from torch import Tensor, nn

from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.by_cell import AbsentSenders, CellRows
from manyeyes.models.fusion.cell_fusion import register_rule


@register_rule("attfuse")
class AttFuse(nn.Module):
    """y = sum_j softmax_j(x_0 . x_j / sqrt(C)) x_j over the senders j of a cell, x_0 that of the ego.

    Where the ego has no feature its query is zero, and the result is the mean.
    """

    def __init__(self, channels: int, attention: AttentionConfig, absent: AbsentSenders) -> None:
        super().__init__()
        self.absent: AbsentSenders = absent

    def forward(self, rows: CellRows) -> Tensor:
        """Fuse the rows to features (U, C) of the cells."""
        x = rows.features
        query = rows.own_features()
        logit = (query[rows.cell] * x).sum(1, keepdim=True) / math.sqrt(x.shape[1])
        # A row of zeros has logit 0 and adds nothing to the sum.
        absent_logit = logit.new_zeros(len(rows.sites), 1) if self.absent == "zero" else None
        return rows.sum(rows.softmax(logit, absent_logit) * x)
