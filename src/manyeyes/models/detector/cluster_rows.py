# SPDX-License-Identifier: Apache-2.0
"""Rows of bytes of clustered tokens: features in float16, equal within a cluster, then the codes of a token's own proposal.

A bare fusion sends no proposals, and its rows are features alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.detector.proposal_codes import PROPOSAL_CODES, proposal_from_codes, proposal_to_codes


def count_own_bytes(is_bare: bool) -> int:
    """Return the number of bytes of a row that are the token's own."""
    return 0 if is_bare else PROPOSAL_CODES


def encode_cluster_rows(tokens: Tensor, is_bare: bool) -> Tensor:
    """Encode packed tokens (N, C) of a bare fusion, or (N, C + PROPOSAL_DIM), to (N, 2 C + own bytes) uint8."""
    features = tokens if is_bare else tokens[:, :-PROPOSAL_DIM]
    as_bytes = features.detach().half().contiguous().view(torch.uint8).view(len(tokens), -1)
    return as_bytes if is_bare else torch.cat((as_bytes, proposal_to_codes(tokens[:, -PROPOSAL_DIM:])), 1)


def decode_cluster_rows(rows: Tensor, is_bare: bool) -> Tensor:
    """Invert encode_cluster_rows up to rounding and the steps of codes; rows (N, 2 C + own bytes) uint8."""
    shared = rows[:, : rows.shape[1] - count_own_bytes(is_bare)]
    features = shared.contiguous().view(torch.float16).float()
    return features if is_bare else torch.cat((features, proposal_from_codes(rows[:, shared.shape[1] :])), 1)
