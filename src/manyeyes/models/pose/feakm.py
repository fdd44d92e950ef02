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
from manyeyes.models.pose.box_descriptors import BoxKeypointNet, BoxKeypoints
from manyeyes.models.pose.keypoint_net import DenseKeypointNet, DenseKeypoints, View
from manyeyes.models.pose.matcher import Matcher, MatcherConfig, Points, mutual
from manyeyes.models.pose.neighbour_geometry import ConstellationConfig

FORMAT = "manyeyes-feakm-1"


@dataclass(frozen=True)
class FeakmConfig:
    """Where keypoints come from and how they are matched. detector: fingerprint (hex) of the weights whose views it was taught
    on; views of others mean nothing to it.
    """

    keypoints: DenseKeypoints | BoxKeypoints
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
        self.keypoints = DenseKeypointNet(kind) if isinstance(kind, DenseKeypoints) else BoxKeypointNet(kind)
        self.matcher = Matcher(config.matcher)

    def describe(self, views: Sequence[View], together: int = 0) -> list[Keypoints]:
        """Keypoints of views, described in groups of so many together (0: all): one, as a sender does, or a pair, as FeaKM's
        code does; only as published does it make a difference.
        """
        return self.keypoints(views, together)

    @torch.no_grad()
    def match(self, ego: Points, other: Points) -> Matches:
        """Points of one view each that are one object, by what they look like and how they stand; no pose is given."""
        if not ego.mask.any() or not other.mask.any():
            return Matches(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0))
        return Matches(*mutual(self.matcher(ego, other)[-1], self.config.matcher.threshold)[0])

    def check_views(self, detector: bytes) -> None:
        """Refuse views of a detector of that fingerprint, where the net was taught on another's."""
        if self.config.detector and self.config.detector != detector.hex():
            raise ConfigError(
                f"This net of FeaKM was taught on views of the weights {self.config.detector}, these are {detector.hex()}; "
                "train it on this detector: manyeyes train --preset feakm --weights DETECTOR."
            )


FEAKM_PAPER = FeakmConfig(DenseKeypoints(), MatcherConfig())
"""As published: 15 M parameters with its 128 input channels."""

FEAKM_SMALL = FeakmConfig(
    BoxKeypoints(),
    MatcherConfig(
        descriptor=32, width=128, layers=4, heads=4, unit_m=10.0, threshold=0.1, constellation=ConstellationConfig()
    ),
)
"""Mended, and at most 2 M parameters."""

FEAKM = {"feakm-paper": FEAKM_PAPER, "feakm": FEAKM_SMALL}


def load(path: Path) -> FeakmNet:
    """A net in evaluation mode, from its own file alone."""
    return checkpoint.load_as(path, FORMAT, FeakmConfig, FeakmNet)
