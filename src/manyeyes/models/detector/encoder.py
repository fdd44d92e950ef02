# SPDX-License-Identifier: Apache-2.0
"""The sparse encoder (CoSTr section III-B): strides 1 to 32, the merge of Eq. 3, and upsampling to the head's stride."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

from manyeyes._bounds import ChannelCount, LayerCount
from manyeyes.datatypes import ConfigError, SparseBev
from manyeyes.models.detector.folded_encoder import FoldedEncoder
from manyeyes.models.detector.layers import DownLayer, SubmanifoldLayer, SubmanifoldStage, UpLayer
from manyeyes.models.detector.pruning import FocalPrune, PruneOutput
from manyeyes.ops.folded_conv import is_supported
from manyeyes.ops.sparse_conv import merge

STRIDES: tuple[int, ...] = (1, 2, 4, 8, 16, 32)


@dataclass(frozen=True)
class EncoderConfig:
    """Settings of the encoder.

    Attributes:
        channels: per stride 1 … 32; the last three are equal, because Eq. 3 sums them.
        layers: submanifold layers per stride 1 … 32.
        prune_strides: strides with a focal pruning layer.
        head_stride: stride of the tokens that are fused, sent and decoded; 8 in the paper.
        dilating: use spconv's strided active set instead of parents only.
        token_channels: width to which tokens are projected before attention; None keeps that of their stride.
        use_coarse_strides: use strides 16 and 32 (Eq. 3); without them the merge has stride 8 alone.
    """

    channels: tuple[ChannelCount, ...] = (32, 64, 128, 128, 128, 128)
    layers: tuple[LayerCount, ...] = (2, 3, 4, 3, 2, 2)
    prune_strides: tuple[int, ...] = (4, 8)
    head_stride: int = 4
    dilating: bool = False
    token_channels: ChannelCount | None = None
    use_coarse_strides: bool = True

    def __post_init__(self) -> None:
        if len(self.channels) != 6 or len(self.layers) != 6:
            raise ConfigError(f"EncoderConfig needs six channels and six layers, strides 1 to 32; got {self}.")
        if len(set(self.channels[3:])) != 1:
            raise ConfigError(
                f"EncoderConfig.channels at strides 8, 16, 32 are summed and must be equal; got {self.channels[3:]}."
            )
        if self.head_stride not in (2, 4, 8):
            raise ConfigError(f"EncoderConfig.head_stride is 2, 4 or 8; got {self.head_stride}.")


@dataclass(frozen=True)
class EncoderOutput:
    """Tokens at the head's stride, the pruning decisions, and the number of sites at each stride."""

    tokens: SparseBev
    pruned: tuple[PruneOutput, ...]
    sites_per_stride: tuple[int, ...]


class SparseEncoder(nn.Module):
    """Encode pillars at stride 1 to tokens at the head's stride."""

    def __init__(self, inputs: int, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        width = dict(zip(STRIDES, config.channels))
        self.strides = STRIDES if config.use_coarse_strides else STRIDES[:4]
        self.down = nn.ModuleList(
            [SubmanifoldLayer(inputs, width[1], kernel=1)]
            + [DownLayer(width[s // 2], width[s], config.dilating) for s in self.strides[1:]]
        )
        stages = zip(self.strides, config.channels, config.layers)
        self.stages = nn.ModuleList(SubmanifoldStage(channels, layers) for _, channels, layers in stages)
        self.prune = nn.ModuleDict({str(s): FocalPrune(width[s]) for s in config.prune_strides})
        self.post_merge = SubmanifoldLayer(width[8], width[8])
        ups = [s for s in (4, 2) if s >= config.head_stride]
        self.up = nn.ModuleDict({str(s): UpLayer(width[2 * s], width[s], width[s]) for s in ups})
        self.out_channels = config.token_channels or width[config.head_stride]
        self.folded: FoldedEncoder | None = None
        self.project = (
            nn.Identity() if config.token_channels is None else nn.Linear(width[config.head_stride], self.out_channels)
        )

    def forward(self, x: SparseBev, prune_threshold: float) -> EncoderOutput:
        """Encode pillars; cells with a probability below prune_threshold are dropped, 0 drops none."""
        if self.folded is not None and is_supported(x.features):
            return EncoderOutput(*self.folded(x, prune_threshold))
        levels: dict[int, SparseBev] = {}
        pruned: list[PruneOutput] = []
        for stride, down, stage in zip(self.strides, self.down, self.stages):
            x = stage(down(x))
            if str(stride) in self.prune:
                x, decision = self.prune[str(stride)](x, prune_threshold)
                pruned.append(decision)
            levels[stride] = x
        tokens = self.post_merge(merge([levels[s] for s in self.strides[3:]]))
        for stride, up in self.up.items():
            tokens = up(tokens, levels[int(stride)])
        tokens = tokens.with_features(self.project(tokens.features))
        return EncoderOutput(tokens, tuple(pruned), tuple(len(levels[s].sites) for s in self.strides))

    def fold(self, in_bfloat16: bool = False) -> None:
        """Join the layers, which are folded before, to one chain of compiled calls; it reads their weights."""
        convs = [layer.folded for layer in (*self.down, self.post_merge)]
        stages = [stage.folded for stage in self.stages]
        is_known = all(stage.folded is not None for stage in self.stages if list(stage.children()))
        if is_known and not self.config.dilating:
            prunes = {s: self.prune[str(s)] for s in self.strides if str(s) in self.prune}
            ups = {int(stride): up.folded for stride, up in self.up.items()}
            self.folded = FoldedEncoder.of(self.strides, convs, stages, prunes, ups, self.project)
