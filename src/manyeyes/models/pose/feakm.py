# SPDX-License-Identifier: Apache-2.0
"""FeaKM's network: keypoints of views and matches between them, published and improved variants behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models import checkpoint
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig, BoxKeypointNet
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig, DenseKeypointNet, DetectorView
from manyeyes.models.pose.matcher import Assignment, KeypointBatch, Matcher, MatcherConfig, find_mutual_matches
from manyeyes.models.pose.neighbour_geometry import NeighbourGeometryConfig
from manyeyes.models.pose.peak_descriptors import PeakKeypointConfig, PeakKeypointNet

FORMAT = "manyeyes-feakm-1"


@dataclass(frozen=True)
class FeakmConfig:
    """Settings of keypoints and matcher.

    detector: fingerprint (hex) of the detector whose views the network was trained on; empty accepts any.
    """

    keypoints: DenseKeypointConfig | BoxKeypointConfig | PeakKeypointConfig
    matcher: MatcherConfig
    detector: str = ""


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches between two sets of keypoints. pairs: (P, 2) rows, unique on either side; probability: (P,)."""

    pairs: Tensor
    probability: Tensor


class FeakmNet(nn.Module):
    """Keypoint descriptors and matcher: senders call describe, the ego calls match on what it received."""

    def __init__(self, config: FeakmConfig) -> None:
        super().__init__()
        self.config = config
        self.keypoints = _make_keypoint_net(config.keypoints)
        self.matcher = Matcher(config.matcher)

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return self.matcher.position_encoder.weight.device

    def assign(self, a: KeypointBatch, b: KeypointBatch) -> list[Assignment]:
        """Return the assignment of every layer of the matcher, on the device of the weights; the last is the result."""
        return self.matcher(a.to(self.device), b.to(self.device))

    def describe(self, views: Sequence[DetectorView], group_size: int = 0) -> list[Keypoints]:
        """Compute keypoints of views in groups of group_size (0: all).

        A sender describes one view; FeaKM's code describes pairs. The group size matters only for the published
        descriptors. Keypoints are returned on the device of the views, wherever the weights are.
        """
        device = self.device
        described = self.keypoints([view.to(device) for view in views], group_size)
        return [points.to(view.confidence.device) for points, view in zip(described, views)]

    @torch.no_grad()
    def match(self, ego_keypoints: KeypointBatch, other_keypoints: KeypointBatch) -> Matches:
        """Match the keypoints of one view each by descriptors and relative geometry, without a prior pose."""
        if not ego_keypoints.mask.any() or not other_keypoints.mask.any():
            none = ego_keypoints.xy.new_zeros(0)
            return Matches(none.new_zeros(0, 2, dtype=torch.int64), none)
        assignment = self.assign(ego_keypoints, other_keypoints)[-1]
        pairs, probability = find_mutual_matches(assignment, self.config.matcher.min_match_prob)[0]
        device = ego_keypoints.xy.device
        return Matches(pairs.to(device), probability.to(device))

    def check_views(self, detector: bytes) -> None:
        """Raise ConfigError where the network was trained on views of another detector than this fingerprint."""
        if self.config.detector and self.config.detector != detector.hex():
            raise ConfigError(
                f"This FeaKM network was trained on views of the weights {self.config.detector}, these are {detector.hex()}; "
                "train it on this detector: manyeyes train --preset feakm-small --weights DETECTOR."
            )


def _make_keypoint_net(
    config: DenseKeypointConfig | BoxKeypointConfig | PeakKeypointConfig,
) -> DenseKeypointNet | BoxKeypointNet | PeakKeypointNet:
    if isinstance(config, DenseKeypointConfig):
        return DenseKeypointNet(config)
    return BoxKeypointNet(config) if isinstance(config, BoxKeypointConfig) else PeakKeypointNet(config)


FEAKM_PAPER = FeakmConfig(DenseKeypointConfig(), MatcherConfig())
"""As published: 15 M parameters with its 128 input channels."""

FEAKM_SMALL = FeakmConfig(
    BoxKeypointConfig(),
    MatcherConfig(
        descriptor_dim=32,
        width=128,
        layers=4,
        heads=4,
        position_unit_m=10.0,
        min_match_prob=0.1,
        neighbour_geometry=NeighbourGeometryConfig(),
    ),
)
"""The improved variant, at most 2 M parameters."""

FEAKM_PEAKS = replace(FEAKM_SMALL, keypoints=PeakKeypointConfig())
"""The improved variant without a confidence map, for Table 3."""

FEAKM = {"feakm-paper": FEAKM_PAPER, "feakm-small": FEAKM_SMALL, "feakm-peaks": FEAKM_PEAKS}


def load(path: Path) -> FeakmNet:
    """Load a network in evaluation mode."""
    return checkpoint.load_as(path, FORMAT, FeakmConfig, FeakmNet)
