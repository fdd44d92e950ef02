# SPDX-License-Identifier: Apache-2.0
"""FeaKM's net, whole: keypoints of views and matches between them, as published and mended behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from manyeyes.datatypes import ConfigError
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.models import checkpoint
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig, BoxKeypointNet
from manyeyes.models.pose.keypoint_net import DenseKeypointConfig, DenseKeypointNet, DetectorView
from manyeyes.models.pose.matcher import KeypointBatch, Matcher, MatcherConfig, find_mutual_matches
from manyeyes.models.pose.neighbour_geometry import NeighbourGeometryConfig

FORMAT = "manyeyes-feakm-1"


@dataclass(frozen=True)
class FeakmConfig:
    """Where keypoints come from and how they are matched. detector: fingerprint (hex) of the weights whose views it was taught
    on; views of others mean nothing to it.
    """

    keypoints: DenseKeypointConfig | BoxKeypointConfig
    matcher: MatcherConfig
    detector: str = ""


@dataclass(frozen=True, eq=False)
class Matches:
    """pairs: (P, 2) rows of two sets of keypoints, no row twice on either side; probability: (P,)."""

    pairs: Tensor
    probability: Tensor


class FeakmNet(nn.Module):
    """describe is what each agent does at home; match is what the ego does with what it was sent."""

    def __init__(self, config: FeakmConfig) -> None:
        super().__init__()
        self.config = config
        kind = config.keypoints
        self.keypoints = DenseKeypointNet(kind) if isinstance(kind, DenseKeypointConfig) else BoxKeypointNet(kind)
        self.matcher = Matcher(config.matcher)

    def describe(self, views: Sequence[DetectorView], group_size: int = 0) -> list[Keypoints]:
        """Keypoints of views, described in groups of so many together (0: all): one, as a sender does, or a pair, as FeaKM's
        code does; only as published does it make a difference.
        """
        return self.keypoints(views, group_size)

    @torch.no_grad()
    def match(self, ego_keypoints: KeypointBatch, other_keypoints: KeypointBatch) -> Matches:
        """Points of one view each that are one object, by what they look like and how they stand; no pose is given."""
        if not ego_keypoints.mask.any() or not other_keypoints.mask.any():
            return Matches(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0))
        return Matches(
            *find_mutual_matches(self.matcher(ego_keypoints, other_keypoints)[-1], self.config.matcher.min_match_prob)[
                0
            ]
        )

    def check_views(self, detector: bytes) -> None:
        """Refuse views of a detector of that fingerprint, where the net was taught on another's."""
        if self.config.detector and self.config.detector != detector.hex():
            raise ConfigError(
                f"This net of FeaKM was taught on views of the weights {self.config.detector}, these are {detector.hex()}; "
                "train it on this detector: manyeyes train --preset feakm-small --weights DETECTOR."
            )


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
"""Mended, and at most 2 M parameters."""

FEAKM = {"feakm-paper": FEAKM_PAPER, "feakm-small": FEAKM_SMALL}


def load(path: Path) -> FeakmNet:
    """A net in evaluation mode, from its own file alone."""
    return checkpoint.load_as(path, FORMAT, FeakmConfig, FeakmNet)
