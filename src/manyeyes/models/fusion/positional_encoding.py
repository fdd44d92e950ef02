# SPDX-License-Identifier: Apache-2.0
"""Spatio-temporal encoding of received tokens (CoSTr Eq. 8, 9, at continuous positions)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion._merge_kernels import EncodingWeights, encode_tokens, layer_pair
from manyeyes.models.fusion.token_merge import PROPOSAL_SCALE
from manyeyes.models.fusion.transform_tokens import POSE_CONTEXT_DIM, Tokens, is_plain

FRAME_CONTEXT_DIM = 3
"""Number of pose-context columns that describe the sender's frame: height, sine and cosine - 1 of its yaw."""


class SpatioTemporalEncoding(nn.Module):
    """Encode position in the cell, sender frame, position sigma, age and proposal, and add them to a feature.

    The age also enters as sines and cosines (Eq. 9, exponent with floor(k / 2), unit 100 ms). Both branches end in zero-initialised
    layers, so that training starts without encoding.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Linear(POSE_CONTEXT_DIM + 2 + PROPOSAL_DIM, 2 * channels)
        self.outer = nn.Linear(2 * channels, channels, bias=False)
        self.temporal = nn.Linear(channels, channels, bias=False)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.temporal.weight)
        self.folded: EncodingWeights | None = None

    def fold(self, in_bfloat16: bool = False) -> None:
        """Copy the weights permanently to one compiled call, in float32; those of the layers are unused afterwards."""
        layers, channels = layer_pair(self.inner, self.outer), self.temporal.in_features
        if layers is not None:
            k = np.arange(channels // 2)
            frequency = (10000.0 ** (-2.0 * k / channels)).astype(np.float32)
            temporal = self.temporal.weight.detach().float().T.contiguous().numpy().copy()
            self.folded = EncodingWeights(layers, PROPOSAL_SCALE.numpy(), temporal, frequency)

    def forward(self, features: Tensor, tokens: Tokens, cell_offset: Tensor) -> Tensor:
        """Encode features (N, C); cell_offset (N, 2) is measured from the cell centre, in cells. Returns (N, C)."""
        if self.folded is not None and is_plain(features, tokens.proposal, tokens.pose_context, cell_offset):
            columns = (features, tokens.pose_context, cell_offset, tokens.proposal)
            x, context, offset, proposal = (t.contiguous().numpy() for t in columns)
            return torch.from_numpy(encode_tokens(x, context, offset, proposal, self.folded, FRAME_CONTEXT_DIM))
        context = (
            tokens.pose_context[:, :FRAME_CONTEXT_DIM],
            cell_offset,
            tokens.proposal * PROPOSAL_SCALE.to(features.device),
            tokens.pose_context[:, FRAME_CONTEXT_DIM:],
        )
        when = temporal_encoding(tokens.age, features.shape[1])
        return features + self.outer(torch.relu(self.inner(torch.cat(context, 1)))) + self.temporal(when)


def temporal_encoding(age: Tensor, channels: int) -> Tensor:
    """Sines and cosines - 1 of age (N,) at frequencies 10000^(-2 floor(k / 2) / channels); returns (N, channels).

    Age is in units of 100 ms. Subtracting one from the cosine makes the encoding of age zero vanish.
    """
    k = torch.arange(channels // 2, device=age.device, dtype=age.dtype)
    angle = age[:, None] * 10000.0 ** (-2.0 * k / channels)
    return torch.stack((angle.sin(), angle.cos() - 1), -1).flatten(1)
