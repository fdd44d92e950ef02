# SPDX-License-Identifier: Apache-2.0
"""FeaKM's published keypoints: peaks of the confidence map, descriptors of a dense network at an eighth of its
resolution.

FeaKM section 4.2.1. Where the paper is silent, the behaviour of its public code is reproduced with its defects: a keypoint is the
corner of its cell, not its centre; channels are scaled by the largest value of all views that are described together, so that the
descriptors of one agent depend on the other; and lists are filled up with unmarked copies of the first grid cell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes._bounds import ChannelCount
from manyeyes.datatypes import Boxes, ConfigError, ShapeError, SparseBev
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.proposal import PROPOSAL_DIM, proposed_heat

DESCRIPTOR_STRIDE = 8
"""Grid cells per cell of the descriptor map."""


@dataclass(frozen=True, eq=False)
class DetectorView:
    """Input of the keypoint networks: one agent's tokens (N, C), their heatmap probabilities (N,) and its decoded boxes in
    descending order of score, all in its own frame.
    """

    tokens: SparseBev
    confidence: Tensor
    boxes: Boxes

    def __post_init__(self) -> None:
        if self.confidence.shape != (len(self.tokens.sites),) or self.tokens.sites.batch_size != 1:
            raise ShapeError(
                f"A DetectorView is of one agent and needs confidence ({len(self.tokens.sites)},); got "
                f"{tuple(self.confidence.shape)} on {self.tokens.sites.batch_size} grids."
            )

    def to(self, device: torch.device) -> DetectorView:
        """Return the same view on a device."""
        return DetectorView(self.tokens.to(device), self.confidence.to(device), self.boxes.to(device=device))

    @classmethod
    def of(cls, shared_tokens: SparseBev, boxes: Boxes) -> DetectorView:
        """Make a view from shared tokens (N, C + PROPOSAL_DIM) and the agent's own boxes."""
        features, proposal = shared_tokens.features[:, :-PROPOSAL_DIM], shared_tokens.features[:, -PROPOSAL_DIM:]
        return cls(shared_tokens.with_features(features), torch.sigmoid(proposed_heat(proposal)), boxes)


@dataclass(frozen=True)
class DenseKeypointConfig:
    """Settings of the dense keypoints.

    Attributes:
        in_channels: channels of the tokens.
        widths: channels of the three blocks, each of which halves the resolution.
        descriptor_dim: length of a descriptor.
        min_score: minimum confidence of a keypoint.
        nms_radius_m: distance within which only the peak is kept.
        border_cells: cells ignored at the edge of the grid.
        num_keypoints: number of keypoints of a view.
        saliency: map whose peaks are taken, "confidence" or the norm of the "feature" (Table 3 without confidence
            map).
    """

    in_channels: ChannelCount = 64
    widths: tuple[ChannelCount, ...] = (128, 128, 256)
    descriptor_dim: ChannelCount = 256
    min_score: float = 0.2
    nms_radius_m: float = 2.4
    border_cells: int = 2
    num_keypoints: int = 128
    saliency: Literal["confidence", "feature"] = "confidence"

    def __post_init__(self) -> None:
        if 2 ** len(self.widths) != DESCRIPTOR_STRIDE:
            raise ConfigError(
                f"DenseKeypointConfig.widths needs three widths, one per downsampling; got {self.widths}."
            )


class DenseKeypointNet(nn.Module):
    """Dense convolutions over the whole grid, as published."""

    def __init__(self, config: DenseKeypointConfig) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        inputs = config.in_channels
        for width in config.widths:
            layers += [*_convolutions(inputs, width), nn.MaxPool2d(2)]
            inputs = width
        self.trunk = nn.Sequential(*layers, *_convolutions(inputs, config.descriptor_dim))
        d = config.descriptor_dim
        self.head = nn.Sequential(
            nn.Conv2d(d, d, 3, padding=1), nn.ReLU(), nn.BatchNorm2d(d), nn.Conv2d(d, d, 1), nn.BatchNorm2d(d)
        )

    def forward(self, views: Sequence[DetectorView], group_size: int = 0) -> list[Keypoints]:
        """Return exactly num_keypoints keypoints of each view, the best first, then padding.

        group_size: number of consecutive views that are scaled by one common maximum; 0 for all.
        """
        features = torch.cat([v.tokens.dense() for v in views]).unflatten(0, (-1, group_size or len(views)))
        scale = features.abs().amax((1, 3, 4), keepdim=True).clamp_min(1e-6)
        described = functional.normalize(self.head(self.trunk((features / scale).flatten(0, 1))))
        return [self._select_keypoints(view, d) for view, d in zip(views, described)]

    def _select_keypoints(self, view: DetectorView, described: Tensor) -> Keypoints:
        config, grid = self.config, view.tokens.grid
        by_confidence = config.saliency == "confidence"
        saliency = view.confidence if by_confidence else functional.normalize(view.tokens.features.norm(dim=1), dim=0)
        map_ = view.tokens.with_features(saliency[:, None]).dense()[0]
        peaks = local_maxima(map_, round(config.nms_radius_m / grid.cell_size_m))[0]
        inside = torch.zeros_like(peaks, dtype=torch.bool)
        b = config.border_cells
        inside[b : grid.shape[0] - b, b : grid.shape[1] - b] = True
        score = torch.where(peaks & inside, map_[0], 0.0).flatten()
        best = score.sort(descending=True, stable=True).indices[: config.num_keypoints]
        best = best[score[best] > (config.min_score if by_confidence else 0.0)]
        cell = torch.cat((best, best.new_zeros(config.num_keypoints - len(best))))
        yx = torch.stack((cell // grid.shape[1], cell % grid.shape[1]), 1)
        score = torch.cat((score[best], score.new_zeros(config.num_keypoints - len(best))))
        # The published half-pixel shift: the corner of the cell, not its centre.
        xy = grid.centers(yx) - grid.cell_size_m / 2
        return Keypoints(
            make_point_boxes(xy, score, grid.cell_size_m / math.sqrt(12)), _sample_descriptors(described, yx)
        )


def make_point_boxes(xy: Tensor, score: Tensor, sigma_xy_m: float) -> Boxes:
    """Make boxes without size and heading at positions (N, 2)."""
    n = len(xy)
    center = torch.cat((xy, xy.new_zeros(n, 1)), 1)
    boxes = Boxes.of(center, torch.zeros_like(center), xy.new_zeros(n), score.to(xy.dtype))
    uncertainty = {"sigma_xy": xy.new_full((n,), sigma_xy_m), "sigma_yaw": xy.new_full((n,), math.inf)}
    return replace(boxes, **uncertainty, p_flip=xy.new_full((n,), 0.5))


def local_maxima(score: Tensor, radius_cells: int, rounds: int = 3) -> Tensor:
    """Return the mask (B, H, W) of local maxima of scores (B, H, W) > 0: non-maximum suppression within radius_cells.

    Each round keeps the maxima among the cells that no kept cell suppresses.
    """
    size = 2 * radius_cells + 1
    kept = torch.zeros_like(score, dtype=torch.bool)
    remaining = score
    for _ in range(rounds):
        kept |= (remaining == functional.max_pool2d(remaining, size, 1, radius_cells)) & (remaining > 0)
        remaining = torch.where(functional.max_pool2d(kept.to(score.dtype), size, 1, radius_cells) > 0, 0.0, score)
    return kept


def _convolutions(inputs: int, outputs: int) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.ReLU()
    ]  # fmt: skip


def _sample_descriptors(described: Tensor, yx: Tensor) -> Tensor:
    """Sample unit descriptors (N, D) from a map (D, h, w) at cells (N, 2).

    Uses SuperPoint's formula, which maps the centre of the first stride to the corner of the map.
    """
    h, w = described.shape[1:]
    extent = torch.tensor([w, h], device=described.device) * DESCRIPTOR_STRIDE - DESCRIPTOR_STRIDE / 2 - 0.5
    place = (yx.flip(1).to(described.dtype) - DESCRIPTOR_STRIDE / 2 + 0.5) / extent * 2 - 1
    sampled = functional.grid_sample(described[None], place[None, None], mode="bilinear", align_corners=True)
    return functional.normalize(sampled[0, :, 0].T)
