# SPDX-License-Identifier: Apache-2.0
"""Multi-scale fusion (FeaKM section 4.3, Eq. 7): tokens that a pose error separates on fine cells share a coarse
cell.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError, Sites, SparseBev
from manyeyes.models.detector.layers import SubmanifoldLayer
from manyeyes.models.detector.transformer import AttentionConfig
from manyeyes.models.fusion.positional_encoding import SpatioTemporalEncoding
from manyeyes.models.fusion.registry import register_fusion
from manyeyes.models.fusion.token_merge import FusedBev, TokenMerge, assign_cells
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.ops.sparse_index import distinct
from manyeyes.ops.voxelize import segment_max


@register_fusion("multi-scale")
class MultiScaleFusion(nn.Module):
    """Maximum over agents at the token stride and at multiples of it, concatenated and projected.

    Eq. 7a downsamples each agent's map and Eq. 7b fuses them. One maximum over a coarse cell does both, because the maximum over
    agents of per-agent maxima is the maximum over all tokens. Initialised to equal MaxFusion: coarser scales have weight zero. It
    has no attention.
    """

    def __init__(self, channels: int, attention: AttentionConfig | None = None, levels: int = 3) -> None:
        super().__init__()
        if levels < 2:
            raise ConfigError(f"MultiScaleFusion needs at least two levels; got {levels}. Maximum fusion has one.")
        self.encoding, self.merge = SpatioTemporalEncoding(channels), TokenMerge(channels, "max")
        self.coarse_scales = nn.ModuleList(CoarseScale(channels, 2**level) for level in range(1, levels))
        self.out = nn.Linear(levels * channels, channels, bias=False)
        with torch.no_grad():
            self.out.weight.copy_(torch.eye(channels, levels * channels, device="cpu"))

    def forward(self, tokens: Tokens, past: Tokens | None = None) -> FusedBev:
        """Fuse the tokens of all agents to one feature and one box per cell; past is ignored."""
        key, place = assign_cells(tokens)
        placed = self.encoding(tokens.features, tokens, place)
        fine = self.merge(placed, tokens, key, place)
        row = torch.searchsorted(fine.bev.sites.key, key)
        masked = placed * tokens.selection_mask[:, None]
        scales = [fine.bev.features, *(scale(masked, row, fine.bev.sites) for scale in self.coarse_scales)]
        return FusedBev(fine.bev.with_features(self.out(torch.cat(scales, 1))), fine.merged_proposals)


class CoarseScale(nn.Module):
    """One coarser scale: max-pool tokens to cells several times as wide, convolve, and copy back to the fine cells."""

    def __init__(self, channels: int, times: int) -> None:
        super().__init__()
        self.times = times
        self.down = nn.Sequential(nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU())
        self.conv = SubmanifoldLayer(channels, channels, norm=nn.LayerNorm)

    def forward(self, features: Tensor, row: Tensor, sites: Sites) -> Tensor:
        """Map features (N, C) of tokens on the fine sites row (N,) to (sites, C)."""
        grid = sites.grid.at(sites.grid.stride * self.times)
        rows, columns = grid.shape
        yx = grid.cells(sites.xy)
        key, parent = distinct((sites.batch * rows + yx[:, 0]) * columns + yx[:, 1], sites.batch_size * rows * columns)
        merged = segment_max(self.down(features), parent[row], len(key))
        coarse = self.conv(SparseBev(merged, Sites(key, grid, sites.batch_size)))
        return coarse.features[parent]
