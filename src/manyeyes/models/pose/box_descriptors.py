# SPDX-License-Identifier: Apache-2.0
"""FeaKM's keypoints, mended: decoded boxes, each described by the tokens around it in the box's own axes.

Against the published ones (models/pose/keypoint_net.py): places are box centres, finer than a cell and without the half pixel;
each view is described alone, every token scaled by its own length; the samples turn with the box, and so do the channels
that are vectors, so that a descriptor does not depend on where its agent looks (specs/pose.md 1.11).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR
from manyeyes.models.detector.box_head import TYPICAL_SIZE
from manyeyes.models.fusion.transform_tokens import rotate_vectors
from manyeyes.models.pose.keypoint_net import View
from manyeyes.ops.sparse_sample import bilinear

WORDS = 5
"""Of a box itself: three sizes, score, its word on its error."""


@dataclass(frozen=True)
class BoxKeypoints:
    """inputs: channels of the tokens, half of them pairs of a vector. descriptor: its length, which is its bytes on the wire.

    width: of the net in between. score_min, most: which boxes are points, the best. along, across: samples by the box's axes,
    pitch_m apart: a car and a lane beside it.
    """

    inputs: int = 64
    descriptor: int = DESCRIPTOR
    width: int = 128
    score_min: float = 0.2
    most: int = 64
    along: int = 5
    across: int = 3
    pitch_m: float = 1.6


class BoxKeypointNet(nn.Module):
    """Samples around each box, and a small net on them; see the module."""

    def __init__(self, config: BoxKeypoints) -> None:
        super().__init__()
        self.config = config
        samples = config.along * config.across
        self.inner = nn.Linear(samples * (config.inputs + 1) + WORDS, config.width)
        self.net = nn.Sequential(nn.LayerNorm(config.width), nn.GELU(), nn.Linear(config.width, config.descriptor))

    def forward(self, views: Sequence[View], together: int = 0) -> list[Keypoints]:
        """The boxes that are sure enough, of each view by itself, however many are given together."""
        return [self._points(view) for view in views]

    def _points(self, view: View) -> Keypoints:
        boxes = view.boxes[view.boxes.score >= self.config.score_min][: self.config.most]
        # Behind the features how much of a sample is occupied: an empty cell and a feature of zero are told apart.
        rows = functional.rms_norm(view.tokens.features, (self.config.inputs,))
        tokens = view.tokens.with_features(torch.cat((rows, rows.new_ones(len(rows), 1)), 1))
        places = boxes.center[:, None, :2].float() + self._offsets(boxes.yaw.float())
        sampled = bilinear(tokens, places.flatten(0, 1))
        turn = -boxes.yaw.float().repeat_interleave(places.shape[1])[:, None]
        around = torch.cat((rotate_vectors(sampled[:, :-1], turn), sampled[:, -1:]), 1)
        around = around.unflatten(0, places.shape[:2]).flatten(1)
        size = (boxes.size.float() / torch.tensor(TYPICAL_SIZE)).clamp_min(1e-3).log()
        words = torch.cat((size, boxes.score[:, None].float(), boxes.sigma_xy[:, None].float().clamp(0, 4)), 1)
        descriptor = self.net(self.inner(torch.cat((around, words), 1)))
        return Keypoints(boxes, functional.normalize(descriptor))

    def _offsets(self, yaw: Tensor) -> Tensor:
        """(N, samples, 2) metres in the agent's axes."""
        config = self.config
        along, across = ((torch.arange(n) - (n - 1) / 2) * config.pitch_m for n in (config.along, config.across))
        x, y = (v.flatten() for v in torch.meshgrid(along, across, indexing="ij"))
        c, s = yaw.cos()[:, None], yaw.sin()[:, None]
        return torch.stack((c * x - s * y, s * x + c * y), -1)
