# SPDX-License-Identifier: Apache-2.0
"""FeaKM's keypoints as published: peaks of the confidence map, descriptors from a dense net at an eighth of its resolution.

FeaKM section 4.2.1; what the paper leaves open follows its public code as specs/pose.md 1.1 to 1.3 describe it, its defects
among them: a point is the corner of its cell, where its centre is meant; channels are scaled by the largest value of *all*
views that are described together, so that one agent's descriptors depend on the other's features; and every list is filled
up to its full length with copies of the lattice's first cell, which nothing marks as padding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes.datatypes import Boxes, ConfigError, ShapeError, SparseBev
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models.detector.proposal import PROPOSAL, proposed_heat

STRIDE = 8
"""Cells of the lattice to one of the descriptors' map."""


@dataclass(frozen=True, eq=False)
class View:
    """What keypoints are taken from: one agent's tokens (N, C), how sure its detector is of an object at each (N,) in [0, 1],
    and its decoded boxes, best first; all in its own frame.
    """

    tokens: SparseBev
    confidence: Tensor
    boxes: Boxes

    def __post_init__(self) -> None:
        if self.confidence.shape != (len(self.tokens.sites),) or self.tokens.sites.batch_size != 1:
            raise ShapeError(
                f"A View is of one agent and needs confidence ({len(self.tokens.sites)},); got "
                f"{tuple(self.confidence.shape)} on {self.tokens.sites.batch_size} grids."
            )

    @classmethod
    def of(cls, told: SparseBev, boxes: Boxes) -> View:
        """From what an agent tells (N, C + PROPOSAL) and its own boxes."""
        features, proposal = told.features[:, :-PROPOSAL], told.features[:, -PROPOSAL:]
        return cls(told.with_features(features), torch.sigmoid(proposed_heat(proposal)), boxes)


@dataclass(frozen=True)
class DenseKeypoints:
    """inputs: channels of the tokens. widths: of the three blocks, each of which halves the resolution; descriptor: its length.

    threshold: least confidence of a point. apart_m: distance within which only the peak stays; border: cells left out at the
    edge; most: points of a view. saliency: the map whose peaks are taken, "confidence" or the length of the "feature": the
    paper's Table 3 without a confidence map.
    """

    inputs: int = 64
    widths: tuple[int, ...] = (128, 128, 256)
    descriptor: int = 256
    threshold: float = 0.2
    apart_m: float = 2.4
    border: int = 2
    most: int = 128
    saliency: Literal["confidence", "feature"] = "confidence"

    def __post_init__(self) -> None:
        if 2 ** len(self.widths) != STRIDE:
            raise ConfigError(f"DenseKeypoints.widths needs three widths, one a halving; got {self.widths}.")


class DenseKeypointNet(nn.Module):
    """Dense convolutions over the whole grid; see the module."""

    def __init__(self, config: DenseKeypoints) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        inputs = config.inputs
        for width in config.widths:
            layers += [*_convolutions(inputs, width), nn.MaxPool2d(2)]
            inputs = width
        self.trunk = nn.Sequential(*layers, *_convolutions(inputs, config.descriptor))
        d = config.descriptor
        self.head = nn.Sequential(
            nn.Conv2d(d, d, 3, padding=1), nn.ReLU(), nn.BatchNorm2d(d), nn.Conv2d(d, d, 1), nn.BatchNorm2d(d)
        )

    def forward(self, views: Sequence[View], together: int = 0) -> list[Keypoints]:
        """Exactly `most` points of each view, the best first and then padding.

        together: views are scaled by the largest value in groups of so many, one after the other; 0: all of them.
        """
        features = torch.cat([v.tokens.dense() for v in views]).unflatten(0, (-1, together or len(views)))
        scale = features.abs().amax((1, 3, 4), keepdim=True).clamp_min(1e-6)
        described = functional.normalize(self.head(self.trunk((features / scale).flatten(0, 1))))
        return [self._points(view, d) for view, d in zip(views, described)]

    def _points(self, view: View, described: Tensor) -> Keypoints:
        config, grid = self.config, view.tokens.grid
        by_confidence = config.saliency == "confidence"
        worth = view.confidence if by_confidence else functional.normalize(view.tokens.features.norm(dim=1), dim=0)
        map_ = view.tokens.with_features(worth[:, None]).dense()[0]
        peaks = local_maxima(map_, round(config.apart_m / grid.cell))[0]
        inside = torch.zeros_like(peaks, dtype=torch.bool)
        b = config.border
        inside[b : grid.shape[0] - b, b : grid.shape[1] - b] = True
        score = torch.where(peaks & inside, map_[0], 0.0).flatten()
        best = score.sort(descending=True, stable=True).indices[: config.most]
        best = best[score[best] > (config.threshold if by_confidence else 0.0)]
        cell = torch.cat((best, best.new_zeros(config.most - len(best))))
        yx = torch.stack((cell // grid.shape[1], cell % grid.shape[1]), 1)
        score = torch.cat((score[best], score.new_zeros(config.most - len(best))))
        # The published half pixel: where a cell begins, not its centre.
        xy = grid.centers(yx) - grid.cell / 2
        return Keypoints(bare_points(xy, score, grid.cell / math.sqrt(12)), _at(described, yx))


def bare_points(xy: Tensor, score: Tensor, sigma_xy_m: float) -> Boxes:
    """Boxes without size or heading at places (N, 2)."""
    n = len(xy)
    center = torch.cat((xy, xy.new_zeros(n, 1)), 1)
    boxes = Boxes.of(center, torch.zeros_like(center), xy.new_zeros(n), score.to(xy.dtype))
    unsure = {"sigma_xy": xy.new_full((n,), sigma_xy_m), "sigma_yaw": xy.new_full((n,), math.inf)}
    return replace(boxes, **unsure, flip=xy.new_full((n,), 0.5))


def local_maxima(score: Tensor, radius: int, rounds: int = 3) -> Tensor:
    """(B, H, W) bool of scores (B, H, W) > 0: greedy suppression within a square of radius cells, in so many rounds.

    Each round keeps what is largest around it among what no kept cell suppresses.
    """
    size = 2 * radius + 1
    kept = torch.zeros_like(score, dtype=torch.bool)
    left = score
    for _ in range(rounds):
        kept |= (left == functional.max_pool2d(left, size, 1, radius)) & (left > 0)
        left = torch.where(functional.max_pool2d(kept.to(score.dtype), size, 1, radius) > 0, 0.0, score)
    return kept


def _convolutions(inputs: int, outputs: int) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.ReLU()
    ]  # fmt: skip


def _at(described: Tensor, yx: Tensor) -> Tensor:
    """(N, D) of a map (D, h, w) at cells (N, 2), of length 1: SuperPoint's formula, which maps the middle of the first
    stride to the corner of the map.
    """
    h, w = described.shape[1:]
    extent = torch.tensor([w, h]) * STRIDE - STRIDE / 2 - 0.5
    place = (yx.flip(1).to(described.dtype) - STRIDE / 2 + 0.5) / extent * 2 - 1
    sampled = functional.grid_sample(described[None], place[None, None], mode="bilinear", align_corners=True)
    return functional.normalize(sampled[0, :, 0].T)
