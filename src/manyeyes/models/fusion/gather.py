# SPDX-License-Identifier: Apache-2.0
"""Tokens of several agents in the ego's frame, at continuous metric positions (CoSTr section III-D.1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, Transform
from manyeyes.models.proposal import PROPOSAL, move_proposal

CUES = 3


@dataclass(frozen=True, eq=False)
class Tokens:
    """N tokens around a batch of egos; cells of different agents may coincide.

    features: (N, C); xy: (N, 2) metres in the ego's frame; ego: (N,) int64, which ego of the batch; cue: (N, CUES) how the
    sender's frame differs from the ego's there (height in metres, sine and cosine - 1 of the relative yaw): zero for its own.
    proposal: (N, PROPOSAL) in the ego's axes, from the token's own place.
    """

    features: Tensor
    xy: Tensor
    ego: Tensor
    cue: Tensor
    proposal: Tensor
    grid: BevGrid
    batch_size: int


def rotate_vectors(features: Tensor, yaw: Tensor) -> Tensor:
    """The first half of the channels are pairs (x, y) of vectors in the sender's frame: turn them by yaw, a scalar.

    A position moves when it changes frames; a direction must turn. Scalar channels, the second half, stay as they are.
    """
    channels = features.shape[1]
    pairs = features[:, : channels // 2].reshape(features.shape[0], channels // 4, 2)
    c, s = yaw.cos().to(features.dtype), yaw.sin().to(features.dtype)
    turned = torch.stack((pairs[..., 0] * c - pairs[..., 1] * s, pairs[..., 0] * s + pairs[..., 1] * c), -1)
    return torch.cat((turned.flatten(1), features[:, channels // 2 :]), 1)


def gather(parts: Iterable[tuple[int, Tensor, Tensor, Transform | None]], grid: BevGrid, batch_size: int) -> Tokens:
    """parts: (ego, told (n, C + PROPOSAL), xy (n, 2) in the sender's frame, ego_from_sender or None for the ego's own).

    Tokens that fall outside the ego's range are dropped. grid: the lattice of the tokens, for all agents alike.
    """
    columns: list[tuple[Tensor, ...]] = []
    for ego, told, xy, ego_from_sender in parts:
        feature, proposal = told[:, :-PROPOSAL], told[:, -PROPOSAL:]
        cue = feature.new_zeros(feature.shape[0], CUES)
        if ego_from_sender is not None:
            yaw = ego_from_sender.yaw
            moved = ego_from_sender.apply(torch.cat((xy, xy.new_zeros(xy.shape[0], 1)), 1).double())
            height = moved[:, 2].to(feature.dtype)
            turn = torch.stack((yaw.sin(), yaw.cos() - 1)).to(feature.dtype).expand(feature.shape[0], 2)
            cue = torch.cat((height[:, None], turn), 1)
            feature, proposal = rotate_vectors(feature, yaw), move_proposal(proposal, yaw, height)
            xy = moved[:, :2].float()
            near = grid.inside(xy)
            feature, xy, cue, proposal = feature[near], xy[near], cue[near], proposal[near]
        columns.append((feature, xy, torch.full((feature.shape[0],), ego, dtype=torch.int64), cue, proposal))
    features, places, egos, cues, proposals = (torch.cat(column) for column in zip(*columns))
    return Tokens(features, places, egos, cues, proposals, grid, batch_size)
