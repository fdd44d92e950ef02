# SPDX-License-Identifier: Apache-2.0
"""Improved FeaKM keypoints: decoded boxes with descriptors of the tokens around them, in the axes of the box.

Differences to the published keypoints (models/pose/keypoint_net.py): positions are box centres, without cell quantisation and
half-pixel shift. Views are described independently, each token scaled by its own norm. Samples and vector channels rotate with the
box, so that a descriptor does not depend on the agent's heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes._bounds import ChannelCount, StageCount
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR_DIM
from manyeyes.models.detector.box_head import TYPICAL_SIZE
from manyeyes.models.fusion.transform_tokens import rotate_vectors
from manyeyes.models.pose.keypoint_net import DetectorView
from manyeyes.ops.sparse_sample import bilinear

BOX_FEATURES_DIM = 5
"""Features of the box itself: three sizes, score, position sigma."""


@dataclass(frozen=True)
class BoxKeypointConfig:
    """Settings of the box descriptors.

    Attributes:
        in_channels: channels of the tokens, half of them (x, y) pairs of vectors.
        descriptor_dim: length of a descriptor, and its bytes in a message.
        hidden_channels: width of the hidden layer.
        min_score: minimum score of a box to be a keypoint.
        max_keypoints: maximum number of keypoints, the highest scores first.
        num_longitudinal_samples: samples along the box.
        num_lateral_samples: samples across the box.
        sample_spacing_m: distance between samples; the default covers a car and a lane on either side.
    """

    in_channels: ChannelCount = 64
    descriptor_dim: ChannelCount = DESCRIPTOR_DIM
    hidden_channels: ChannelCount = 128
    min_score: float = 0.2
    max_keypoints: int = 64
    num_longitudinal_samples: StageCount = 5
    num_lateral_samples: StageCount = 3
    sample_spacing_m: float = 1.6


class BoxKeypointNet(nn.Module):
    """Sample tokens around each box and encode them with a small network."""

    def __init__(self, config: BoxKeypointConfig) -> None:
        super().__init__()
        self.config = config
        samples = config.num_longitudinal_samples * config.num_lateral_samples
        self.inner = nn.Linear(samples * (config.in_channels + 1) + BOX_FEATURES_DIM, config.hidden_channels)
        self.net = nn.Sequential(
            nn.LayerNorm(config.hidden_channels), nn.GELU(), nn.Linear(config.hidden_channels, config.descriptor_dim)
        )

    def forward(self, views: Sequence[DetectorView], group_size: int = 0) -> list[Keypoints]:
        """Describe the boxes of each view with at least min_score; group_size has no effect."""
        return [self._describe(view) for view in views]

    def _describe(self, view: DetectorView) -> Keypoints:
        boxes = view.boxes[view.boxes.score >= self.config.min_score][: self.config.max_keypoints]
        # An occupancy channel distinguishes an empty cell from a feature of zero.
        rows = functional.rms_norm(view.tokens.features, (self.config.in_channels,))
        tokens = view.tokens.with_features(torch.cat((rows, rows.new_ones(len(rows), 1)), 1))
        sample_xy = boxes.center[:, None, :2].float() + self._offsets(boxes.yaw.float())
        sampled = bilinear(tokens, sample_xy.flatten(0, 1))
        turn = -boxes.yaw.float().repeat_interleave(sample_xy.shape[1])[:, None]
        around = torch.cat((rotate_vectors(sampled[:, :-1], turn), sampled[:, -1:]), 1)
        around = around.unflatten(0, sample_xy.shape[:2]).flatten(1)
        size = (boxes.size.float() / rows.new_tensor(TYPICAL_SIZE)).clamp_min(1e-3).log()
        box_features = torch.cat((size, boxes.score[:, None].float(), boxes.sigma_xy[:, None].float().clamp(0, 4)), 1)
        descriptor = self.net(self.inner(torch.cat((around, box_features), 1)))
        return Keypoints(boxes, functional.normalize(descriptor))

    def _offsets(self, yaw: Tensor) -> Tensor:
        """Return the sample positions (N, samples, 2) relative to the box centres, metres in the agent's axes."""
        config = self.config
        longitudinal, lateral = (
            (torch.arange(n, device=yaw.device) - (n - 1) / 2) * config.sample_spacing_m
            for n in (config.num_longitudinal_samples, config.num_lateral_samples)
        )
        x, y = (v.flatten() for v in torch.meshgrid(longitudinal, lateral, indexing="ij"))
        c, s = yaw.cos()[:, None], yaw.sin()[:, None]
        return torch.stack((c * x - s * y, s * x + c * y), -1)
