# SPDX-License-Identifier: Apache-2.0
"""The semi-global map model: extract_features (sensors to tokens), fuse (tokens to a tile), predict_elements.

Source: CrowdMap section 2.2. All observations, the ego's included, reach the tile as tokens: ground cells with a feature each,
warped by the reported pose. A frame is one agent at one time: ten frames of a tile may be ten agents, or one agent that passed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, LayerCount
from manyeyes.datatypes import BevGrid, ConfigError, PointCloud, Sites, SparseBev, Transform
from manyeyes.datatypes.camera import CameraImage
from manyeyes.models.maps.bev import BevConfig, CameraBev, LidarBev
from manyeyes.models.maps.head import MapHead, MapHeadConfig, QueryGroup, RawMap
from manyeyes.models.maps.image_encoder import FeaturePyramid, ResidualBlock
from manyeyes.models.maps.line_field_head import RawLineField
from manyeyes.ops.bev_warp import masked_max, warp_bev

FRAMES_PER_TILE = 10
"""Frames per tile, CrowdMap section 3.1."""


@dataclass(frozen=True)
class MapModelConfig:
    """Settings of the map model.

    Attributes:
        bev: encoder of one agent's sensors.
        tile: area of the predicted map in its own frame, 120 m by 60 m in the paper.
        token_channels: channels of the shared tokens.
        neck_blocks: residual blocks on the fused tile, at one, two and four times its cell size.
        head: of the map elements.
    """

    bev: BevConfig
    tile: BevGrid
    token_channels: ChannelCount = 32
    neck_blocks: tuple[LayerCount, ...] = (1, 1, 1)
    head: MapHeadConfig = field(default_factory=MapHeadConfig)

    def __post_init__(self) -> None:
        if self.tile.stride != 1:
            raise ConfigError(f"MapModelConfig.tile is given at stride 1; got {self.tile.stride}.")


@dataclass(frozen=True, eq=False)
class MapFeatures:
    """Features of a batch of frames: tokens (N, C) on one grid per frame.

    line_logits: (N, kinds) logits that an element of a class passes through the cell.
    """

    tokens: SparseBev
    line_logits: Tensor

    @property
    def cell_score(self) -> Tensor:
        """(N,) maximum class probability; under a budget the highest are sent."""
        return self.line_logits.detach().sigmoid().amax(1)

    def to(self, device: torch.device) -> MapFeatures:
        """Return the same features on a device."""
        return MapFeatures(self.tokens.to(device), self.line_logits.to(device))


class MapModel(nn.Module):
    """Predict the map elements of tiles from the sensor data of several frames."""

    def __init__(self, config: MapModelConfig) -> None:
        super().__init__()
        self.config = config
        self.fingerprint = bytes(8)
        self.token_peaks: tuple[float, ...] | None = None
        bev, head, tokens = config.bev, config.head, config.token_channels
        self.lidar = LidarBev(bev) if "lidar" in bev.sensors else None
        self.camera = CameraBev(bev) if "camera" in bev.sensors else None
        self.token_projection = nn.Conv2d(bev.channels, tokens, 1)
        self.line_classifier = nn.Linear(tokens, len(head.kinds))
        nn.init.constant_(self.line_classifier.bias, -3.0)
        self.empty_feature = nn.Parameter(torch.zeros(tokens, device="cpu"))
        widths = tuple(min(head.channels, 2 * tokens * 2**i) for i in range(len(config.neck_blocks)))
        # Inputs beside the features: the number of frames that observed the cell, and its coordinates in the tile.
        inputs, stages = tokens + 3, []
        for i, (count, width) in enumerate(zip(config.neck_blocks, widths)):
            blocks = [ResidualBlock(inputs, width, 2 if i else 1)] + [
                ResidualBlock(width, width) for _ in range(count - 1)
            ]
            stages.append(nn.Sequential(*blocks))
            inputs = width
        self.neck = nn.ModuleList(stages)
        self.pyramid = FeaturePyramid(widths, head.channels)
        self.head = MapHead(head)
        # Per class, set after training (training/maps/score_calibration.py), so that scores are calibrated
        # probabilities.
        self.logit_scale, self.logit_shift = (
            nn.Buffer(torch.ones(len(head.kinds), device="cpu")),
            nn.Buffer(torch.zeros(len(head.kinds), device="cpu")),
        )

    @property
    def device(self) -> torch.device:
        """The device of the weights, where clouds, images and tokens are moved to; agents keep to the CPU."""
        return self.empty_feature.device

    @property
    def token_grid(self) -> BevGrid:
        """The grid of the tokens, in each agent's frame."""
        return self.config.bev.token_grid

    def extract_features(
        self, clouds: Sequence[PointCloud] = (), images: Sequence[Sequence[CameraImage]] = ()
    ) -> MapFeatures:
        """Encode clouds, images, or both, of N frames in their agents' frames; tokens cover the observed ground.

        A model of both sensors accepts either alone.
        """
        branches = [
            net(inputs) for net, inputs in ((self.lidar, clouds), (self.camera, images)) if net is not None and inputs
        ]
        if not branches:
            raise ConfigError(f"This map model has {', '.join(self.config.bev.sensors)}; give their data.")
        features, seen = torch.stack([e[0] for e in branches], 1), torch.stack([e[1] for e in branches], 1)
        merged = self.token_projection(masked_max(features, seen, features.new_zeros(features.shape[2])))
        flat = merged.permute(0, 2, 3, 1).flatten(0, 2)
        key = seen.any(1).flatten().nonzero()[:, 0]
        tokens = SparseBev(flat[key], Sites(key, self.token_grid, merged.shape[0]))
        return MapFeatures(tokens, self.line_classifier(tokens.features))

    def fuse(self, tokens: SparseBev, tile_from_agent: Transform, tile_index: Tensor, num_tiles: int) -> Tensor:
        """Fuse the received tokens of N frames to tile features (tiles, C, rows, columns); arguments as for
        ``warp_tokens``.

        The result does not depend on the order of frames, nor on frames without coverage of their tile.
        """
        return self.fuse_features(*self.warp_tokens(tokens, tile_from_agent, tile_index, num_tiles))

    def warp_tokens(
        self, tokens: SparseBev, tile_from_agent: Transform, tile_index: Tensor, num_tiles: int
    ) -> tuple[Tensor, Tensor]:
        """Warp the tokens of N frames to the cells of their tiles.

        Args:
            tokens: of N frames, one grid each.
            tile_from_agent: N transforms, from reported or corrected poses.
            tile_index: (N,) int64, the tile of each frame.
            num_tiles: number of tiles.

        Returns:
            Features (tiles, K, C, rows, columns) of at most K frames per tile, and the observed mask (tiles, K, rows,
            columns).
        """
        rows, columns = self.config.tile.shape
        tokens, tile_index = tokens.to(self.device), tile_index.to(self.device)
        dense = tokens.dense()
        there = dense.new_zeros(dense.shape[0] * dense.shape[2] * dense.shape[3], dtype=torch.bool)
        there[tokens.sites.key] = True
        moved, seen = warp_bev(
            dense, there.view(dense.shape[0], *dense.shape[2:]), tokens.grid, self.config.tile, tile_from_agent
        )
        # The n-th frame of a tile takes its n-th slot; empty slots observe nothing.
        place = (tile_index[:, None] == tile_index[None]).tril(-1).sum(1)
        max_frames = int(place.max()) + 1 if len(tile_index) else 1
        slot = tile_index * max_frames + place
        features = moved.new_zeros(num_tiles * max_frames, moved.shape[1], rows, columns).index_copy(0, slot, moved)
        views = seen.new_zeros(num_tiles * max_frames, rows, columns).index_copy(0, slot, seen)
        return features.unflatten(0, (num_tiles, max_frames)), views.unflatten(0, (num_tiles, max_frames))

    def fuse_features(self, features: Tensor, seen: Tensor) -> Tensor:
        """Fuse features (B, K, C, rows, columns) of K frames with their observed masks to (B, D, rows, columns)."""
        fused = masked_max(features, seen, self.empty_feature)
        coverage = seen.sum(1, keepdim=True).to(fused.dtype).log1p()
        b, _, rows, columns = fused.shape
        y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, device=fused.device) for n in (rows, columns)), indexing="ij")
        x = torch.cat((fused, coverage, torch.stack((x, y)).expand(b, 2, rows, columns)), 1)
        x = x.contiguous(memory_format=torch.channels_last)
        levels = []
        for stage in self.neck:
            x = stage(x)
            levels.append(x)
        return self.pyramid(levels)

    def predict_line_field(self, ground: Tensor) -> RawLineField:
        """Predict the line field of tile features (B, D, rows, columns)."""
        return self.head.line_field_head(ground)

    def predict_elements(
        self, ground: Tensor, group: QueryGroup = "one", line_field: RawLineField | None = None
    ) -> tuple[RawMap, ...]:
        """Predict the elements of tile features (B, D, rows, columns): one RawMap per layer, the last the best.

        line_field: of these features, if already computed. Outside training, the scores of the last layer are
        calibrated.
        """
        *before, last = self.head(ground, self.predict_line_field(ground) if line_field is None else line_field, group)
        if not self.training:
            last = RawMap(last.logit * self.logit_scale + self.logit_shift, last.point)
        return (*before, last)

    def forward(self, features: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Map warped frames, as for ``fuse_features``, to the last layer's logits and points; the exported part of
        the model.
        """
        raw = self.predict_elements(self.fuse_features(features, seen))[-1]
        return raw.logit, raw.point
