# SPDX-License-Identifier: Apache-2.0
"""What a feature must be told of where and when it comes from (CoSTr Eq. 8, 9, with continuous places)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.models.fusion.token_merge import PROPOSAL_SCALE
from manyeyes.models.fusion.transform_tokens import POSE_CONTEXT_DIM, Tokens

FRAME_CONTEXT_DIM = 3
"""The first cues: height and turn of the sender."""


class SpatioTemporalEncoding(nn.Module):
    """Tells a feature where it landed: its place in its cell, its sender's frame, doubt and age, and what the sender proposed.

    The age enters as sines and cosines too (Eq. 9; exponent with floor(k / 2), unit 100 ms). Both ways end in zeros, so that
    fusion starts as if without.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Linear(POSE_CONTEXT_DIM + 2 + PROPOSAL_DIM, 2 * channels)
        self.outer = nn.Linear(2 * channels, channels, bias=False)
        self.temporal = nn.Linear(channels, channels, bias=False)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.temporal.weight)

    def forward(self, features: Tensor, tokens: Tokens, cell_offset: Tensor) -> Tensor:
        """(N, C) to (N, C); place (N, 2) from the cell's centre, in cells."""
        context = (
            tokens.pose_context[:, :FRAME_CONTEXT_DIM],
            cell_offset,
            tokens.proposal * PROPOSAL_SCALE,
            tokens.pose_context[:, FRAME_CONTEXT_DIM:],
        )
        when = temporal_encoding(tokens.age, features.shape[1])
        return features + self.outer(torch.relu(self.inner(torch.cat(context, 1)))) + self.temporal(when)


def temporal_encoding(age: Tensor, channels: int) -> Tensor:
    """(N, channels): sines and cosines - 1 of age (N,), in its units, at frequencies 10000^(-2 floor(k / 2) / channels).

    Cosine less one, so that the encoding of now is zero and changes nothing.
    """
    k = torch.arange(channels // 2, device=age.device, dtype=age.dtype)
    angle = age[:, None] * 10000.0 ** (-2.0 * k / channels)
    return torch.stack((angle.sin(), angle.cos() - 1), -1).flatten(1)
