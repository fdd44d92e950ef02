# SPDX-License-Identifier: Apache-2.0
"""Tokens of several agents in the ego's frame, at continuous metric positions (CoSTr section III-D.1)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes import BevGrid, SparseBev, Transform
from manyeyes.ops.sparse_conv import coalesce

CUES = 3


@dataclass(frozen=True, eq=False)
class Tokens:
    """N tokens around a batch of egos; cells of different agents may coincide.

    features: (N, C); xy: (N, 2) metres in the ego's frame; ego: (N,) int64, which ego of the batch; cue: (N, CUES) how the
    sender's frame differs from the ego's there (height in metres, sine and cosine - 1 of the relative yaw): zero for its own.
    """

    features: Tensor
    xy: Tensor
    ego: Tensor
    cue: Tensor
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
    """parts: (ego, features (n, C), xy (n, 2) in the sender's frame, ego_from_sender or None for the ego's own).

    Tokens that fall outside the ego's range are dropped. grid: the lattice of the tokens, for all agents alike.
    """
    features, places, egos, cues = [], [], [], []
    for ego, feature, xy, ego_from_sender in parts:
        cue = feature.new_zeros(feature.shape[0], CUES)
        if ego_from_sender is not None:
            yaw = ego_from_sender.yaw
            moved = ego_from_sender.apply(torch.cat((xy, xy.new_zeros(xy.shape[0], 1)), 1).double())
            turn = torch.stack((yaw.sin(), yaw.cos() - 1)).to(feature.dtype).expand(feature.shape[0], 2)
            cue = torch.cat((moved[:, 2:].to(feature.dtype), turn), 1)
            feature, xy = rotate_vectors(feature, yaw), moved[:, :2].float()
            near = grid.inside(xy)
            feature, xy, cue = feature[near], xy[near], cue[near]
        features.append(feature)
        places.append(xy)
        cues.append(cue)
        egos.append(torch.full((feature.shape[0],), ego, dtype=torch.int64))
    return Tokens(torch.cat(features), torch.cat(places), torch.cat(egos), torch.cat(cues), grid, batch_size)


def own_tokens(bev: SparseBev) -> Tokens:
    """Every grid of a batch as an ego that hears nobody."""
    sites = bev.sites
    cue = bev.features.new_zeros(len(sites), CUES)
    return Tokens(bev.features, sites.xy, sites.batch, cue, sites.grid, sites.batch_size)


def join(first: Tokens, second: Tokens) -> Tokens:
    """Two batches of egos as one; the second's egos are numbered on from the first's."""
    return Tokens(
        torch.cat((first.features, second.features)),
        torch.cat((first.xy, second.xy)),
        torch.cat((first.ego, second.ego + first.batch_size)),
        torch.cat((first.cue, second.cue)),
        first.grid,
        first.batch_size + second.batch_size,
    )


def lattice_offset(tokens: Tokens) -> tuple[Tensor, Tensor]:
    """Key (N,) of the nearest cell and the token's offset (N, 2) from that cell's centre, in cells."""
    rows, columns = tokens.grid.shape
    yx = tokens.grid.cells(tokens.xy)
    key = (tokens.ego * rows + yx[:, 0]) * columns + yx[:, 1]
    return key, (tokens.xy - tokens.grid.centers(yx)) / tokens.grid.cell


def to_lattice(features: Tensor, key: Tensor, tokens: Tokens, reduce: str) -> SparseBev:
    """Tokens on their nearest cells, one feature a cell."""
    assert reduce in ("mean", "max")
    return coalesce(features, key, tokens.grid, tokens.batch_size, reduce=reduce)  # pyright: ignore[reportArgumentType]
