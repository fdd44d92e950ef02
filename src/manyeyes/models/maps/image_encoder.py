# SPDX-License-Identifier: Apache-2.0
"""Encode images to features at an eighth or a quarter of their size: a residual network and a feature pyramid.

Sources: He et al., CVPR 2016 (basic and bottleneck blocks); Lin et al., CVPR 2017 (top-down pyramid). Batch norms use running
statistics after training, so that the features of one agent do not depend on the rest of the batch. A norm over channels does not
train on rasters, most of whose cells are empty: docs/concepts/map-model.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from manyeyes._bounds import ChannelCount, LayerCount
from manyeyes.datatypes import ConfigError


@dataclass(frozen=True)
class ImageEncoderConfig:
    """Settings of the image encoder.

    Attributes:
        blocks: residual blocks at strides 4, 8, 16, …; two stages or more.
        stem_channels: channels of the first stage, doubled by each further stage.
        bottleneck: 1-3-1 blocks with four times the channels (ResNet-50 is (3, 4, 6, 3), 64, True); else 3-3 blocks
            (ResNet-18 is (2, 2, 2, 2), 64, False).
        channels: of the pyramid and the output.
        stride: of the output, 8 or 4; feature o is centred on pixel stride * o.
        gradient_checkpointing: recompute block activations in the backward pass, bitwise equal; saves memory for
            time.
    """

    blocks: tuple[LayerCount, ...] = (2, 2, 2, 2)
    stem_channels: ChannelCount = 64
    bottleneck: bool = False
    channels: ChannelCount = 128
    stride: int = 8
    gradient_checkpointing: bool = False

    def __post_init__(self) -> None:
        if len(self.blocks) < 2 or min(self.blocks) < 1:
            raise ConfigError(
                f"ImageEncoderConfig.blocks needs two or more stages of a block or more; got {self.blocks}."
            )
        if len(self.blocks) > 8 or self.stem_channels << (len(self.blocks) - 1) > 4096:
            raise ConfigError(f"ImageEncoderConfig has at most 8 stages and 4096 channels in the last; got {self}.")
        if self.stride not in (4, 8):
            raise ConfigError(f"ImageEncoderConfig.stride is 4 or 8; got {self.stride}.")


def conv_norm(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Make a convolution and norm; sizes are divided by the stride, rounded up."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, bias=False), nn.BatchNorm2d(outputs)
    )


class ResidualBlock(nn.Module):
    """A residual block; the shortcut is projected where size or channels change."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, bottleneck: bool = False) -> None:
        super().__init__()
        inner = outputs // 4 if bottleneck else outputs
        layers = (
            [
                conv_norm(inputs, inner, 1),
                nn.ReLU(),
                conv_norm(inner, inner, 3, stride),
                nn.ReLU(),
                conv_norm(inner, outputs, 1),
            ]
            if bottleneck
            else [conv_norm(inputs, inner, 3, stride), nn.ReLU(), conv_norm(inner, outputs, 3)]
        )
        self.inner = nn.Sequential(*layers)
        self.shortcut = nn.Identity() if inputs == outputs and stride == 1 else conv_norm(inputs, outputs, 1)
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, h, w) to (N, outputs, ceil(h / stride), ceil(w / stride))."""
        # Not a strided convolution: with 12 channels in channels_last, its gradient overran its buffer (torch 2.13,
        # CPU).
        return torch.relu(self.shortcut(x[..., :: self.stride, :: self.stride]) + self.inner(x))


def upsample(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Upsample (N, C, h, w) by two, bilinear, cropped to size; cell o maps to cell 2 o, as in strided layers."""
    h, w = x.shape[-2:]
    padded = F.pad(x, (0, 1, 0, 1), mode="replicate")
    return F.interpolate(padded, (2 * h + 1, 2 * w + 1), mode="bilinear", align_corners=True)[..., : size[0], : size[1]]


class FeaturePyramid(nn.Module):
    """Merge maps of decreasing size, top-down, to one map of the size of the first."""

    def __init__(self, inputs: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(c, channels, 1) for c in inputs)
        self.smooth = conv_norm(channels, channels, 3)

    def forward(self, levels: list[Tensor]) -> Tensor:
        """Map (N, inputs[i], h_i, w_i), finest first, to (N, channels, h_0, w_0)."""
        laterals = [lateral(level) for lateral, level in zip(self.lateral, levels)]
        down = laterals[-1]
        for level in laterals[-2::-1]:
            down = level + upsample(down, level.shape[-2:])
        return torch.relu(self.smooth(down))


class ImageEncoder(nn.Module):
    """Encode colour images to features of the configured stride."""

    def __init__(self, config: ImageEncoderConfig) -> None:
        super().__init__()
        grow = 4 if config.bottleneck else 1
        self.stem = nn.Sequential(conv_norm(3, config.stem_channels, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        widths = [config.stem_channels * grow * 2**i for i in range(len(config.blocks))]
        stages, inputs = [], config.stem_channels
        for i, (count, width) in enumerate(zip(config.blocks, widths)):
            blocks = [ResidualBlock(inputs, width, 2 if i else 1, config.bottleneck)]
            blocks += [ResidualBlock(width, width, 1, config.bottleneck) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inputs = width
        self.stages = nn.ModuleList(stages)
        self.finest = 1 if config.stride == 8 else 0
        self.pyramid = FeaturePyramid(tuple(widths[self.finest :]), config.channels)
        self.gradient_checkpointing = config.gradient_checkpointing

    def forward(self, rgb: Tensor) -> Tensor:
        """Map (V, 3, h, w) uint8, or floats in [0, 255], to (V, channels, ceil(h / stride), ceil(w / stride))."""
        x = self._run(self.stem, rgb.to(torch.float32) / 64 - 2)
        levels = []
        for stage in self.stages:
            for block in stage.children():
                x = self._run(block, x)
            levels.append(x)
        return self.pyramid(levels[self.finest :])

    def _run(self, part: nn.Module, x: Tensor) -> Tensor:
        if not (self.gradient_checkpointing and self.training and torch.is_grad_enabled()):
            return part(x)
        return cast(
            Tensor,
            checkpoint(part, x, use_reentrant=False, context_fn=lambda: (nullcontext(), _freeze_norm_statistics(part))),
        )


@contextmanager
def _freeze_norm_statistics(part: nn.Module) -> Iterator[None]:
    """Do not update running statistics a second time during recomputation."""
    norms = [module for module in part.modules() if isinstance(module, nn.BatchNorm2d)]
    before = [(norm, norm.momentum, norm.num_batches_tracked) for norm in norms]
    for norm in norms:
        norm.momentum, norm.num_batches_tracked = 0.0, None
    try:
        yield
    finally:
        for norm, momentum, batches in before:
            norm.momentum, norm.num_batches_tracked = momentum, batches
