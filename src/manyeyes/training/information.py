# SPDX-License-Identifier: Apache-2.0
"""What the selector is taught beside detection itself: to say little (L1), and to say what matters (CoSTr Eq. 10 to 12).

The letter of Eq. 10 compares an aggregate with itself and teaches nothing (detection.md 5.2 has the audit and the toy). Here the
masked words of a window are compared with what its own task says matters there, by an un-normalised product: a mask that
withholds what matters lowers the agreement, and no scale of the mask cancels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import SparseBev
from manyeyes.models.proposal import PROPOSAL
from manyeyes.ops.voxelize import segment_sum
from manyeyes.ops.window_attention import window_ids

WINDOW_CELLS = 8
TEMPERATURE = 0.1


def information_terms(told: SparseBev, mask: Tensor, matters: Tensor) -> tuple[Tensor, Tensor]:
    """(mean of the mask, InfoNCE in nats) of told tokens (N, C + PROPOSAL); mask (N,), matters (N,) in [0, 1] from the truth."""
    if not len(mask):
        zero = mask.sum()
        return zero, zero
    features = functional.normalize(told.features[:, :-PROPOSAL].detach(), dim=1)
    grid = told.grid
    ids = window_ids(told.sites.xy, told.sites.batch, (grid.x_min, grid.y_min), WINDOW_CELLS * grid.cell)
    row = ids.unique(return_inverse=True)[1]
    return mask.mean(), window_information(features, mask, matters, row)


def window_information(features: Tensor, mask: Tensor, matters: Tensor, row: Tensor) -> Tensor:
    """Symmetric InfoNCE, scalar, between the masked and the mattering part of each window; features (N, C), row (N,) windows.

    z^X is the mean over a window of mask * feature, not divided by the sum of the mask; z^Y that of matters * feature, which
    carries no gradient. Windows without anything that matters are negatives only.
    """
    windows = int(row.max()) + 1
    count = torch.bincount(row, minlength=windows).to(mask.dtype)[:, None]
    x = segment_sum(mask[:, None] * features, row, windows) / count.sqrt()
    y = segment_sum(matters[:, None] * features, row, windows).detach() / count.sqrt()
    some = (segment_sum(matters[:, None], row, windows)[:, 0] > 0.5).nonzero()[:, 0]
    if len(some) < 2:
        return mask.sum() * 0
    agree = x @ y.mT / TEMPERATURE
    right = functional.cross_entropy(agree[some], some)
    return (right + functional.cross_entropy(agree.mT[some], some)) / 2
