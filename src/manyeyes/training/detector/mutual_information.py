# SPDX-License-Identifier: Apache-2.0
"""Losses of the token selector: L1 norm of the mask and mutual information of the kept tokens (CoSTr Eq. 10 to 12).

Eq. 10 as printed compares an aggregate with itself, so its gradient carries no information. Here the masked tokens of a window are
compared with its relevant tokens according to the detector's own targets, by an unnormalised product. Masking relevant tokens
lowers the agreement, and no scale of the mask cancels. Two more targets are for studies: the receiver's own features, which is the
corrected paper but drops what only the sender observes, and Eq. 10 as printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from manyeyes.datatypes import SparseBev
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.ops.voxelize import segment_sum
from manyeyes.ops.window_attention import window_ids

WINDOW_CELLS = 8
TEMPERATURE = 0.1
InformationTarget = Literal["own_task", "receiver", "literal"]


def mutual_information_loss(tokens: SparseBev, mask: Tensor, relevance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean mask and InfoNCE in nats of tokens (N, C + PROPOSAL_DIM); mask (N,), ground-truth relevance
    (N,) in [0, 1].
    """
    if not len(mask):
        zero = mask.sum()
        return zero, zero
    features = functional.normalize(tokens.features[:, :-PROPOSAL_DIM].detach(), dim=1)
    grid = tokens.grid
    ids = window_ids(tokens.sites.xy, tokens.sites.batch, (grid.x_min, grid.y_min), WINDOW_CELLS * grid.cell_size_m)
    found, row = ids.unique(return_inverse=True)
    return mask.mean(), window_mutual_information(features, mask, relevance, row, len(found))


def window_mutual_information(
    features: Tensor, mask: Tensor, relevance: Tensor, row: Tensor, windows: int | None = None
) -> Tensor:
    """Return the symmetric InfoNCE, scalar, between the masked and the relevant part of each window; features (N, C), row (N,)
    windows, and how many of them, None to count.

    z^X is the window mean of mask * feature, not divided by the sum of the mask. z^Y is that of relevance * feature
    and carries no gradient.
    Windows without relevant tokens are negatives only.
    """
    windows = int(row.max()) + 1 if windows is None else windows
    count = mask.new_zeros(windows, 1).index_add_(0, row, torch.ones_like(mask)[:, None])
    x = segment_sum(mask[:, None] * features, row, windows) / count.sqrt()
    y = segment_sum(relevance[:, None] * features, row, windows).detach() / count.sqrt()
    some = (segment_sum(relevance[:, None], row, windows)[:, 0] > 0.5).nonzero()[:, 0]
    return _info_nce(x, y, some) if len(some) >= 2 else mask.sum() * 0


@dataclass(frozen=True, eq=False)
class AgentPairTokens:
    """Senders' and receivers' tokens in the receivers' windows, for the study targets.

    sent (N, C) and own (M, C): unit features, rotated to the receivers' axes; sent_mask (N,); sent_row (N,) and own_row (M,):
    window numbers from 0.
    """

    sent: Tensor
    sent_mask: Tensor
    sent_row: Tensor
    own: Tensor
    own_row: Tensor


def receiver_mutual_information(pairs: AgentPairTokens) -> Tensor:
    """Return the symmetric InfoNCE, scalar, between the sent tokens and the receiver's own tokens of each window.

    Windows with tokens of one side only are ignored, so tokens that only the sender has gain nothing.
    """
    windows = _count_windows(pairs)
    sent, own = (torch.bincount(row, minlength=windows) for row in (pairs.sent_row, pairs.own_row))
    both = ((sent > 0) & (own > 0)).nonzero()[:, 0]
    if len(both) < 2:
        return pairs.sent_mask.sum() * 0
    x = segment_sum(pairs.sent_mask[:, None] * pairs.sent, pairs.sent_row, windows)[both] / sent[both, None].sqrt()
    y = segment_sum(pairs.own, pairs.own_row, windows)[both].detach() / own[both, None].sqrt()
    return _info_nce(x, y, torch.arange(len(both), device=both.device))


def paper_mutual_information(pairs: AgentPairTokens) -> Tensor:
    """Negative of Eq. 11 with the joint aggregate of Eq. 10, scalar: each window's unit vector against itself and all
    others.
    """
    windows = _count_windows(pairs)
    if not windows:
        return pairs.sent_mask.sum() * 0
    joint = segment_sum(pairs.sent_mask[:, None] * pairs.sent, pairs.sent_row, windows)
    z = functional.normalize(joint + segment_sum(pairs.own, pairs.own_row, windows).detach(), dim=1)
    z = z[torch.unique(torch.cat((pairs.sent_row, pairs.own_row)))]
    return functional.cross_entropy(z @ z.mT / TEMPERATURE, torch.arange(len(z), device=z.device))


STUDY_TARGETS = {"receiver": receiver_mutual_information, "literal": paper_mutual_information}


def _count_windows(pairs: AgentPairTokens) -> int:
    rows = torch.cat((pairs.sent_row, pairs.own_row))
    return int(rows.max()) + 1 if len(rows) else 0


def _info_nce(x: Tensor, y: Tensor, some: Tensor) -> Tensor:
    """InfoNCE of windows (W, C) of one side against the other; anchors are a subset, negatives are all windows."""
    agree = x @ y.mT / TEMPERATURE
    right = functional.cross_entropy(agree[some], some)
    return (right + functional.cross_entropy(agree.mT[some], some)) / 2
