# SPDX-License-Identifier: Apache-2.0
"""The detector: extract_features (point cloud to tokens), predict (own boxes), fuse (tokens of all agents to boxes)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor, nn

from manyeyes._bounds import ChannelCount, FiniteFloat
from manyeyes.datatypes import VEHICLES, BevGrid, Boxes, ConfigError, PointCloud, SparseBev
from manyeyes.models.detector.box_head import BOX_LAYOUT, BoxHead, DecodeConfig, RawBoxes, RefineHead, decode
from manyeyes.models.detector.cluster_rows import count_own_bytes, decode_cluster_rows, encode_cluster_rows
from manyeyes.models.detector.codebook import Codebook, CodebookConfig
from manyeyes.models.detector.encoder import EncoderConfig, SparseEncoder
from manyeyes.models.detector.pillars import PillarEncoder, PillarKind
from manyeyes.models.detector.proposal import NO_HEAT_LOGIT, PROPOSAL_DIM, make_bare_proposals, make_proposals
from manyeyes.models.detector.pruning import FocalPrune, PruneOutput
from manyeyes.models.detector.selector import Selector
from manyeyes.models.detector.transformer import AttentionConfig, WindowTransformer
from manyeyes.models.fusion.by_cell import CellRows
from manyeyes.models.fusion.cell_fusion import BareFusion, RuleFusion
from manyeyes.models.fusion.clusters import ClusterCompression
from manyeyes.models.fusion.how2comm import How2comm, SpatialGate
from manyeyes.models.fusion.registry import get_fusion
from manyeyes.models.fusion.token_merge import FusedBev
from manyeyes.models.fusion.transform_tokens import AgentTokens, Tokens, to_ego_frame
from manyeyes.models.score_calibration import ScoreCalibration
from manyeyes.ops.lidar.sweep_statistics import SensorDomain
from manyeyes.ops.voxelize import segment_max


@dataclass(frozen=True)
class DetectorConfig:
    """Settings of a detector.

    Attributes:
        grid: perception range of an agent and pillar size.
        pillars: type of the pillar encoder.
        fusion: name of the fusion module (``models.fusion.registry``).
        prune_threshold: cells with a lower probability of being near an object are dropped.
        output_range: range in which boxes are evaluated where it is smaller than grid; None for all of grid.
        sweeps: number of consecutive sweeps in the input.
        codebook: of the token encoding; None before one is fitted.
        classes: of objects that are detected, of ``datatypes.CLASSES``; one heat map for each.
        min_sent_score: tokens of a lower score are not sent, in [0, 1) (``agents.strategies.redundancy``); 0 sends all.
    """

    grid: BevGrid
    pillars: PillarKind = "points"
    pillar_channels: ChannelCount = 32
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    dast: AttentionConfig = field(default_factory=AttentionConfig)
    fusion: str = "self-attention"
    fusion_attention: AttentionConfig = field(default_factory=AttentionConfig)
    head_channels: ChannelCount = 64
    prune_threshold: FiniteFloat = 0.1
    decode: DecodeConfig = field(default_factory=DecodeConfig)
    output_range: BevGrid | None = None
    sweeps: Literal[1, 2] = 1
    codebook: CodebookConfig | None = None
    # Absent from stored configurations where it is the default, so that fingerprints of earlier weights hold.
    classes: tuple[str, ...] = field(default=VEHICLES, metadata={"omit_default": True})
    min_sent_score: FiniteFloat = field(default=0.0, metadata={"omit_default": True})


@dataclass(frozen=True)
class ExtractedFeatures:
    """Features of a batch of agents: tokens to fuse or send, and the decisions of the pruning layers."""

    tokens: SparseBev
    pruned: tuple[PruneOutput, ...]
    sites_per_stride: tuple[int, ...]


class Detector(nn.Module):
    """CoSTr on sparse features: pillars, encoder with focal pruning, DAST, centre head, fusion and box refinement."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        self.grid, self.detection_range = config.grid, config.output_range or config.grid
        self.fingerprint = bytes(8)
        self.token_peaks: tuple[float, ...] | None = None
        self.score_calibration: ScoreCalibration | None = None
        self.sensor_domain: SensorDomain | None = None
        self.pillars = PillarEncoder(config.grid, config.pillar_channels, config.pillars, config.sweeps)
        self.encoder = SparseEncoder(config.pillar_channels, config.encoder)
        channels = self.encoder.out_channels
        self.dast = WindowTransformer(channels, config.dast)
        self.token_prune = FocalPrune(channels)
        self.selector = Selector(channels)
        self.fusion = get_fusion(config.fusion)(channels, config.fusion_attention)
        self.head = BoxHead(channels, config.head_channels, config.classes)
        self.is_bare = bool(getattr(self.fusion, "is_bare", False))
        self.refine = None if self.is_bare else RefineHead(channels, config.head_channels, config.classes)
        if config.codebook is not None:
            self.check_has_proposals()
        self.codebook = None if config.codebook is None else Codebook(channels, config.codebook)

    def check_has_proposals(self) -> None:
        """Raise ConfigError where the fusion sends features without proposals, which have no codebook."""
        if self.is_bare:
            raise ConfigError(
                f"fusion {self.config.fusion} sends features without proposals: it has no codebook; use float16."
            )

    @property
    def device(self) -> torch.device:
        """The device of the weights; results are returned on the device of the inputs, so that agents keep to the CPU."""
        return self.head.out.weight.device

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of objects that are detected, and evaluated apart."""
        return self.config.classes

    @property
    def min_sent_score(self) -> float:
        """Tokens of a lower score are not sent."""
        return self.config.min_sent_score

    @property
    def token_grid(self) -> BevGrid:
        """The grid of the tokens."""
        return self.config.grid.at(self.config.encoder.head_stride)

    @property
    def token_channels(self) -> int:
        """Number of columns of a shared token, before it is packed."""
        return self.encoder.out_channels + PROPOSAL_DIM

    @property
    def packed_channels(self) -> int:
        """Number of columns of a token that is sent: of a bare fusion features, and what it needs of the proposal."""
        return self.encoder.out_channels + len(self._sent_proposal) if self.is_bare else self.token_channels

    @property
    def _sent_proposal(self) -> list[int]:
        """Columns of the proposal that a bare fusion sends: the confidence, and the velocity, if it needs them."""
        spans = {"sends_confidence": BOX_LAYOUT.heatmap_logit, "sends_velocity": BOX_LAYOUT.velocity}
        needed = [span for name, span in spans.items() if getattr(self.fusion, name, False)]
        return [column for span in needed for column in range(span.start, span.stop)]

    @property
    def decode_config(self) -> DecodeConfig:
        """Settings by which raw boxes are decoded."""
        return self.config.decode

    def detect(self, points: PointCloud, previous: PointCloud | None = None) -> Boxes:
        """Detect the boxes of a point cloud, in its frame, by falling score; previous: the sweep before, in the same frame."""
        with torch.inference_mode():
            return decode(self.extract_tokens(points, previous)[1], self.config.decode)[0]

    def extract_tokens(self, points: PointCloud, previous: PointCloud | None = None) -> tuple[SparseBev, RawBoxes]:
        """Encode one point cloud to the tokens that its agent shares (N, token_channels), and to raw boxes."""
        before = points[:0] if previous is None else previous
        tokens = self.extract_features([points], [before]).tokens
        raw = self.predict(tokens)
        shared = self.make_tokens(tokens, raw).to(points.xyz.device)
        return shared, raw.on(shared.sites)

    def extract_features(
        self,
        clouds: list[PointCloud],
        previous_clouds: list[PointCloud] | None = None,
        prune_threshold: float | None = None,
    ) -> ExtractedFeatures:
        """Encode one point cloud per agent, in its own frame, to tokens on one grid per agent.

        previous_clouds: the previous sweeps, transformed to the same frames.
        """
        threshold = self.config.prune_threshold if prune_threshold is None else prune_threshold
        encoded = self.encoder(self.pillars(clouds, previous_clouds), threshold)
        tokens = encoded.tokens
        sites = tokens.sites
        tokens = tokens.with_features(self.dast(tokens.features, sites.xy, sites.batch, sites.grid, sites.cache))
        kept, decision = self.token_prune(tokens, threshold)
        return ExtractedFeatures(kept, (*encoded.pruned, decision), encoded.sites_per_stride)

    def predict(self, tokens: SparseBev) -> RawBoxes:
        """Predict boxes from each agent's own tokens, in its own frame."""
        return self.head(tokens)

    def make_tokens(self, tokens: SparseBev, raw: RawBoxes) -> SparseBev:
        """Concatenate features (N, C) and the proposals of raw to the shared tokens (N, C + PROPOSAL_DIM)."""
        return tokens.with_features(torch.cat((tokens.features, make_proposals(raw)), 1))

    def pack_tokens(self, tokens: SparseBev) -> SparseBev:
        """Return the columns of shared tokens that are sent (N, packed_channels)."""
        if not self.is_bare:
            return tokens
        channels = self.encoder.out_channels
        columns = [*range(channels), *(channels + column for column in self._sent_proposal)]
        return tokens.with_features(tokens.features[:, columns])

    def unpack_tokens(self, tokens: SparseBev) -> SparseBev:
        """Return received tokens (N, packed_channels) as (N, token_channels); proposals that were not sent are neutral."""
        if not self.is_bare:
            return tokens
        channels, rows = self.encoder.out_channels, tokens.features
        proposals = make_bare_proposals(rows.new_full((len(rows),), NO_HEAT_LOGIT))
        proposals[:, self._sent_proposal] = rows[:, channels:]
        return tokens.with_features(torch.cat((rows[:, :channels], proposals), 1))

    @property
    def has_gate(self) -> bool:
        """Whether the fusion has a gate that acts at the sender (How2comm)."""
        return isinstance(getattr(self.fusion, "rule", None), How2comm)

    def attend_tokens(self, tokens: SparseBev) -> Tensor:
        """Return the spatial attention (N,) in [0, 1] of an agent to its shared tokens, by a fusion that has_gate."""
        rows, row, spatial = self._gate(tokens)
        return spatial.attend(rows)[row, 0].to(tokens.features.device)

    def gate_tokens(self, tokens: SparseBev, request: Tensor) -> Tensor:
        """Return the gates (N,) in [0, 1] of an agent's shared tokens, by a fusion that has_gate.

        request: (N,) in [0, 1], 1 - attention of the receiver that requests most.
        """
        rows, row, spatial = self._gate(tokens)
        largest = segment_max(request.to(rows.features)[:, None], row, len(rows.cell))
        return spatial.open(rows, largest, spatial.attend(rows))[row, 0].to(tokens.features.device)

    def _gate(self, tokens: SparseBev) -> tuple[CellRows, Tensor, SpatialGate]:
        """Return the rows of an agent's own tokens as its fusion takes them, the row (N,) of each token, and the gate."""
        fusion, rule = self.fusion, getattr(self.fusion, "rule", None)
        if not (isinstance(fusion, RuleFusion | BareFusion) and isinstance(rule, How2comm)):
            raise ConfigError(f"fusion {self.config.fusion} has no gate at the sender; how2comm has one.")
        own = to_ego_frame([AgentTokens(0, tokens.features, tokens.sites.xy)], tokens.grid, 1)
        return *fusion.gather(own.to(self.device)), rule.spatial

    @property
    def cluster_form(self) -> tuple[int, int] | None:
        """Channels of a row of a cluster and bytes of a token's own, where the fusion sends clusters; None otherwise."""
        sends_clusters = isinstance(getattr(self.fusion, "compression", None), ClusterCompression)
        return (self.encoder.out_channels, count_own_bytes(self.is_bare)) if sends_clusters else None

    def compress_tokens(self, tokens: SparseBev) -> SparseBev:
        """Return the shared tokens (N, token_channels) of each message of a batch as their senders compress them."""
        compression = getattr(self.fusion, "compression", None)
        if compression is None or not len(tokens.sites):
            return tokens
        channels, given = self.encoder.out_channels, tokens.features
        rows = given.to(self.device)
        sizes = torch.bincount(tokens.sites.batch, minlength=tokens.sites.batch_size).tolist()
        parts = [compression(part).features for part in rows[:, :channels].split(sizes)]
        return tokens.with_features(torch.cat((torch.cat(parts), rows[:, channels:]), 1).to(given.device))

    def score_for_sampling(self, tokens: SparseBev) -> Tensor:
        """Return the learned score (N,) in (0, 1) by which a fusion that sends clusters samples shared tokens.

        Raises:
            ConfigError: the fusion makes no clusters.
        """
        compression = getattr(self.fusion, "compression", None)
        if not isinstance(compression, ClusterCompression):
            raise ConfigError(f"fusion {self.config.fusion} has no sampling score; ermvp has one.")
        features = tokens.features[:, : self.encoder.out_channels]
        return compression.score(features.to(self.device)).to(features.device)

    def encode_clusters(self, tokens: Tensor) -> Tensor:
        """Encode packed tokens (N, packed_channels) to rows of bytes (N, 2 C + own bytes), equal within a cluster."""
        return encode_cluster_rows(tokens, self.is_bare)

    def decode_clusters(self, rows: Tensor) -> Tensor:
        """Invert encode_clusters, up to float16 and the steps of proposal codes."""
        return decode_cluster_rows(rows, self.is_bare)

    def score_tokens(self, tokens: SparseBev) -> Tensor:
        """Return importance logits (N,) of the tokens; under a budget the highest are sent."""
        return self.selector(tokens.to(self.device)).to(tokens.features.device)

    def fuse(self, tokens: Tokens, past: Tokens | None = None) -> tuple[FusedBev, RawBoxes]:
        """Fuse the tokens of all agents around each ego, its own included; and raw boxes in the ego's frame.

        Boxes of a bare fusion come from the single-agent head on the fused features.

        past: the ego's tokens of earlier instants, transformed to its current frame.
        """
        given = tokens.features.device
        fused = self.fusion(tokens.to(self.device), None if past is None else past.to(self.device))
        raw = self.head(fused.bev) if self.refine is None else self.refine(fused.bev, fused.merged_proposals)
        fused = fused.to(given)
        return fused, raw.on(fused.bev.sites)
