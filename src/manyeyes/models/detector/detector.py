# SPDX-License-Identifier: Apache-2.0
"""The detector: see (one agent's cloud to tokens), look (its own boxes), fuse (tokens of all agents to boxes around the ego)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from manyeyes.datatypes import BevGrid, PointCloud, SparseBev
from manyeyes.models.detector.box_head import BoxHead, DecodeConfig, RawBoxes, RefineHead
from manyeyes.models.detector.codebook import Codebook, CodebookConfig
from manyeyes.models.detector.encoder import EncoderConfig, SparseEncoder
from manyeyes.models.detector.pillars import PillarEncoder, PillarKind
from manyeyes.models.detector.proposal import propose
from manyeyes.models.detector.pruning import FocalPrune, Pruned
from manyeyes.models.detector.selector import Selector
from manyeyes.models.detector.transformer import AttentionConfig, WindowTransformer
from manyeyes.models.fusion.flow_aware import FlowAwareFusion
from manyeyes.models.fusion.max_fusion import MaximumFusion
from manyeyes.models.fusion.multi_scale import MultiScaleFusion
from manyeyes.models.fusion.self_attention import SelfAttentionFusion
from manyeyes.models.fusion.token_merge import Fused
from manyeyes.models.fusion.transform_tokens import Tokens
from manyeyes.models.fusion.v2x_vit import V2xVitFusion


@dataclass(frozen=True)
class DetectorConfig:
    """grid: what an agent sees and tells, and the pillar size. prune_threshold: probability of lying near an object below which
    a cell is dropped. answers: the range in which its boxes are asked for, where that is less than it sees; None: all of it.
    sweeps: how many an agent looks at together, its last one or two. codebook: of the bytes that its tokens are sent as; None
    where none was fitted.
    """

    grid: BevGrid
    pillars: PillarKind = "points"
    pillar_channels: int = 32
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    dast: AttentionConfig = field(default_factory=AttentionConfig)
    fusion: Literal["flow_aware", "self_attention", "maximum", "multi_scale", "v2x_vit"] = "self_attention"
    fusion_attention: AttentionConfig = field(default_factory=AttentionConfig)
    head_channels: int = 64
    prune_threshold: float = 0.1
    decode: DecodeConfig = field(default_factory=DecodeConfig)
    answers: BevGrid | None = None
    sweeps: Literal[1, 2] = 1
    codebook: CodebookConfig | None = None

    @property
    def range(self) -> BevGrid:
        """Where boxes are asked for."""
        return self.answers or self.grid


@dataclass(frozen=True)
class Seen:
    """What a batch of agents made of their own clouds: tokens to keep or send, and pruning's decisions."""

    tokens: SparseBev
    pruned: tuple[Pruned, ...]
    sites_per_stride: tuple[int, ...]


class Detector(nn.Module):
    """CoSTr's path on sparse features: pillars, encoder with focal pruning, DAST, a centre head; fusion and a second look."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        self.fingerprint = bytes(8)
        self.pillars = PillarEncoder(config.grid, config.pillar_channels, config.pillars, config.sweeps)
        self.encoder = SparseEncoder(config.pillar_channels, config.encoder)
        channels = self.encoder.out_channels
        self.dast = WindowTransformer(channels, config.dast)
        self.token_prune = FocalPrune(channels)
        self.selector = Selector(channels)
        self.fusion = _fusion(channels, config)
        self.head = BoxHead(channels, config.head_channels)
        self.refine = RefineHead(channels, config.head_channels)
        self.codebook = None if config.codebook is None else Codebook(channels, config.codebook)

    @property
    def token_grid(self) -> BevGrid:
        """The lattice of the tokens."""
        return self.config.grid.at(self.config.encoder.head_stride)

    def see(
        self,
        clouds: list[PointCloud],
        earlier: list[PointCloud] | None = None,
        prune_threshold: float | None = None,
    ) -> Seen:
        """Clouds in their agents' frames to tokens on a batch of as many grids. earlier: the sweeps before, in the same frames."""
        threshold = self.config.prune_threshold if prune_threshold is None else prune_threshold
        encoded = self.encoder(self.pillars(clouds, earlier), threshold)
        tokens = encoded.tokens
        sites = tokens.sites
        tokens = tokens.with_features(self.dast(tokens.features, sites.xy, sites.batch, sites.grid, sites.cache))
        kept, decision = self.token_prune(tokens, threshold)
        return Seen(kept, (*encoded.pruned, decision), encoded.sites_per_stride)

    def look(self, tokens: SparseBev) -> RawBoxes:
        """What each agent makes of its own tokens, in its own frame."""
        return self.head(tokens)

    def tell(self, tokens: SparseBev, raw: RawBoxes) -> SparseBev:
        """What is sent: features (N, C) and, behind them, the proposals of raw, the agent's own view of these tokens."""
        return tokens.with_features(torch.cat((tokens.features, propose(raw)), 1))

    def choose(self, told: SparseBev) -> Tensor:
        """(N,) logits of how much each token is worth to others; a budget sends the highest."""
        return self.selector(told)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> RawBoxes:
        """Tokens of all agents around each ego, its own among them, to raw boxes in the ego's frame.

        past: what the ego itself told at its last instants, moved into its frame of now.
        """
        fused = self.merge(tokens, past)
        return self.refine(fused.bev, fused.given)

    def merge(self, tokens: Tokens, past: Tokens | None = None) -> Fused:
        """The first half of fuse: one feature and one merged box a cell."""
        return self.fusion(tokens, past)


_ATTENTIVE = {"flow_aware": FlowAwareFusion, "self_attention": SelfAttentionFusion, "v2x_vit": V2xVitFusion}


def _fusion(
    channels: int, config: DetectorConfig
) -> FlowAwareFusion | SelfAttentionFusion | MaximumFusion | MultiScaleFusion | V2xVitFusion:
    if config.fusion in _ATTENTIVE:
        return _ATTENTIVE[config.fusion](channels, config.fusion_attention)
    return MaximumFusion(channels) if config.fusion == "maximum" else MultiScaleFusion(channels)
