# SPDX-License-Identifier: Apache-2.0
"""The baseline: dense PointPillars with attention fusion at three scales, as it is deployed (norms folded, channels last).

Pillars of 10 features to a dense map; three blocks of a strided 3x3 convolution and more of stride 1 (Lang et al. 2019);
at each scale every cell of the ego attends to the same cell of all agents (AttFuse: Xu et al., OPV2V, ICRA 2022); each
fused scale is brought to stride 2, all are concatenated, and 1x1 heads predict two anchors a cell. Weights are random:
only time is measured. Maps of the others are taken as already aligned with the ego's, so the baseline has no cost of warping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, PointCloud
from manyeyes.models.detector.pillars import PillarEncoder
from manyeyes.ops.nms import rotated_nms

ANCHORS = ((4.5, 1.9, 1.6, 0.0), (4.5, 1.9, 1.6, math.pi / 2))
FIELDS = 7


@dataclass(frozen=True)
class DenseConfig:
    """channels and extra_layers: one entry a block, strides 2, 4, 8; up: channels of each scale after its way up."""

    grid: BevGrid
    pillar_channels: int = 64
    channels: tuple[int, ...] = (64, 128, 256)
    extra_layers: tuple[int, ...] = (3, 5, 8)
    up: int = 128


class Block(nn.Sequential):
    """A 3x3 convolution of stride 2 and more of stride 1, each with the bias that its folded norm leaves, and ReLU."""

    def __init__(self, inputs: int, outputs: int, extra: int) -> None:
        layers: list[nn.Module] = [nn.Conv2d(inputs, outputs, 3, 2, 1), nn.ReLU(inplace=True)]
        for _ in range(extra):
            layers += [nn.Conv2d(outputs, outputs, 3, 1, 1), nn.ReLU(inplace=True)]
        super().__init__(*layers)


def attend(maps: Tensor) -> Tensor:
    """(A, C, H, W) of all agents, the ego first, to (1, C, H, W): softmax over agents of <ego, agent> / sqrt(C), per cell."""
    cells = maps.permute(0, 2, 3, 1)
    scores = torch.stack([torch.linalg.vecdot(cells[0], cell) for cell in cells])
    weight = torch.softmax(scores / math.sqrt(maps.shape[1]), 0)[..., None]
    fused = cells[0] * weight[0]
    for cell, agent_weight in zip(cells[1:], weight[1:]):
        fused.addcmul_(cell, agent_weight)
    return fused.permute(2, 0, 1)[None]


class DensePointPillars(nn.Module):
    """extract_maps: a cloud to three maps; fuse: maps of all agents to anchors' scores and boxes."""

    def __init__(self, config: DenseConfig) -> None:
        super().__init__()
        self.config = config
        self.pillars = PillarEncoder(config.grid, config.pillar_channels, "points")
        inputs = (config.pillar_channels, *config.channels[:-1])
        self.blocks = nn.ModuleList(map(Block, inputs, config.channels, config.extra_layers))
        self.ups = nn.ModuleList(
            nn.Sequential(nn.ConvTranspose2d(c, config.up, 2**i, 2**i), nn.ReLU(inplace=True))
            for i, c in enumerate(config.channels)
        )
        total = config.up * len(config.channels)
        self.score = nn.Conv2d(total, len(ANCHORS), 1)
        self.boxes = nn.Conv2d(total, len(ANCHORS) * FIELDS, 1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        nn.init.normal_(self.boxes.weight, std=0.01)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.eval().requires_grad_(False)

    def extract_maps(self, cloud: PointCloud) -> list[Tensor]:
        """One map a scale, (1, C, H, W)."""
        x, maps = self.pillars([cloud]).dense(), []
        for block in self.blocks:
            x = block(x)
            maps.append(x)
        return maps

    def fuse(self, scales: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Maps (A, C, H, W) of all agents at each scale, the ego first, to logits (1, 2, H, W) and boxes (1, 14, H, W)."""
        ups = torch.cat([up(attend(maps)) for up, maps in zip(self.ups, scales)], 1)
        return self.score(ups), self.boxes(ups)

    def share(self, cloud: PointCloud) -> list[bytes]:
        """The three maps as float32 bytes: what attention at three scales needs from every agent."""
        return self.pack(self.extract_maps(cloud))

    def pack(self, maps: list[Tensor]) -> list[bytes]:
        """Maps as they are sent."""
        return [m.permute(0, 2, 3, 1).numpy().tobytes() for m in maps]

    def perceive(self, own: list[Tensor], messages: list[list[bytes]], candidates: int) -> Tensor:
        """(K, 5) boxes x, y, length, width, yaw: the best of so many candidates that survive rotated NMS."""
        scales = []
        for i, mine in enumerate(own):
            cells = torch.empty(1 + len(messages), *mine.shape[2:], mine.shape[1])
            cells[0] = mine[0].permute(1, 2, 0)
            for k, message in enumerate(messages, 1):
                cells[k].numpy()[:] = np.frombuffer(message[i], np.float32).reshape(cells.shape[1:])
            scales.append(cells.permute(0, 3, 1, 2))
        logits, boxes = self.fuse(scales)
        best, rows = torch.sigmoid(logits).flatten().topk(candidates)
        found = decode_anchors(boxes, rows, self.config.grid.at(2))
        return found[rotated_nms(found.double(), best, 0.15)]


def decode_anchors(boxes: Tensor, rows: Tensor, grid: BevGrid) -> Tensor:
    """(K, 5) of the anchors rows (K,), numbered anchor by anchor, row by row, from fields (1, 14, H, W)."""
    _, _, height, width = boxes.shape
    anchor, cell = rows.div(height * width, rounding_mode="floor"), rows.remainder(height * width)
    fields = boxes.view(len(ANCHORS), FIELDS, height * width)[anchor, :, cell]
    yx = torch.stack((cell.div(width, rounding_mode="floor"), cell.remainder(width)), 1)
    typical = torch.tensor(ANCHORS)[anchor]
    diagonal = torch.linalg.vector_norm(typical[:, :2], dim=1, keepdim=True)
    xy = grid.centers(yx) + fields[:, :2] * diagonal
    return torch.cat((xy, typical[:, :2] * fields[:, 3:5].exp(), typical[:, 3:] + fields[:, 6:]), 1)
