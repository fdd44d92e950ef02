# SPDX-License-Identifier: Apache-2.0
"""Salient points of one agent's view, each with a descriptor by which another agent can recognise it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manyeyes.datatypes.boxes import Boxes
from manyeyes.datatypes.errors import ShapeError
from manyeyes.datatypes.transform import Transform


@dataclass(frozen=True)
class Keypoints:
    """N points in an agent's frame: what FeaKM sends of them is their places and descriptors (FeaKM section 4.2.1), here as
    Message.objects and Message.descriptors.

    boxes: what stands at each point; a bare point has size 0, yaw 0 and an infinite sigma_yaw, for it has no heading.
    descriptor: (N, D), of length 1 (0 where there is nothing to describe).
    """

    boxes: Boxes
    descriptor: Tensor

    def __post_init__(self) -> None:
        if self.descriptor.dim() != 2 or self.descriptor.shape[0] != len(self.boxes):
            raise ShapeError(f"Keypoints needs descriptors ({len(self.boxes)}, D); got {tuple(self.descriptor.shape)}.")

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index: Tensor | slice) -> Keypoints:
        return Keypoints(self.boxes[index], self.descriptor[index])

    @property
    def xy(self) -> Tensor:
        """Positions (N, 2) in metres."""
        return self.boxes.center[:, :2]

    def to(self, device: torch.device) -> Keypoints:
        """Return the same points on a device."""
        return Keypoints(self.boxes.to(device=device), self.descriptor.to(device))

    def transform(self, target_from_source: Transform) -> Keypoints:
        """Return the same points in another frame; descriptors stay as they are."""
        return Keypoints(self.boxes.transform(target_from_source), self.descriptor)
