# SPDX-License-Identifier: Apache-2.0
"""Mirroring of samples, left to right, and scaling of their lengths."""

from __future__ import annotations

import torch
from torch import Tensor

from manyeyes.datatypes import PointCloud, Transform


def mirror_factors(flip: bool, dtype: torch.dtype) -> Tensor:
    """Return the factors (3,) of x, y and z."""
    return torch.tensor([1.0, -1.0 if flip else 1.0, 1.0], dtype=dtype, device="cpu")


def resize_cloud(cloud: PointCloud, scale: float, flip: bool) -> PointCloud:
    """Return the cloud in a scaled, mirrored frame."""
    return cloud.scale((scale, -scale if flip else scale, scale))


def resize_transform(motion: Transform, scale: float, flip: bool) -> Transform:
    """Return the transform between two scaled, mirrored frames."""
    mirror = mirror_factors(flip, motion.rotation.dtype)
    return Transform(mirror[:, None] * motion.rotation * mirror, motion.translation * mirror * scale)
