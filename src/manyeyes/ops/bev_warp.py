# SPDX-License-Identifier: Apache-2.0
"""Warp BEV feature maps between frames, and take the masked maximum over agents.

Unseen cells are not zero: a maximum against zero would clip every negative feature beside an agent's horizon. Here a cell out of
an agent's view is minus infinity, and one that no agent has seen gets a vector of its own. Source: CrowdMap section 2.2 (affine
warp, bilinear, maxout); F-Cooper, Chen et al. 2019 (maxout); the mask is an addition.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from manyeyes.datatypes import BevGrid, ShapeError, Transform

MIN_SEEN_FRACTION = 0.5
"""A place is seen where more than this share of the bilinear weight falls on seen cells."""


def warp_bev(
    features: Tensor, seen: Tensor, source: BevGrid, target: BevGrid, target_from_source: Transform
) -> tuple[Tensor, Tensor]:
    """Warp features (N, C, h, w) on one grid to (N, C, H, W) on another, and which places (N, H, W) are seen there.

    seen: (N, h, w) bool. target_from_source: N motions, of which the planar part counts: x, y and yaw. Each place is the mean of
    the seen cells around it by their bilinear weights; unseen places are zero.
    """
    if features.shape[-2:] != source.shape or seen.shape != features.shape[:1] + features.shape[-2:]:
        raise ShapeError(
            f"warp_bev needs features (N, C, {source.shape[0]}, {source.shape[1]}) and seen of the same cells; got "
            f"{tuple(features.shape)} and {tuple(seen.shape)}."
        )
    at = _places(source, target, target_from_source).to(features)
    seen_weight = seen[:, None].to(features.dtype)
    both = torch.cat((features * seen_weight, seen_weight), 1)
    moved = F.grid_sample(both, at, mode="bilinear", padding_mode="zeros", align_corners=False)
    weight = moved[:, -1:]
    visible = weight > MIN_SEEN_FRACTION
    return moved[:, :-1] / weight.clamp_min(MIN_SEEN_FRACTION) * visible, visible[:, 0]


def _places(source: BevGrid, target: BevGrid, target_from_source: Transform) -> Tensor:
    """Return (N, H, W, 2) where the centres of target's cells lie in source, -1 and 1 being its outer borders; float64."""
    (rows, columns), device = target.shape, target_from_source.translation.device
    row, column = torch.meshgrid(torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij")
    xy = target.centers(torch.stack((row, column), -1).view(-1, 2)).double()
    moved = xy - target_from_source.translation[:, None, :2].double()
    yaw = target_from_source.yaw.double()
    c, s = yaw.cos()[:, None], yaw.sin()[:, None]
    x, y = moved[..., 0] * c + moved[..., 1] * s, moved[..., 1] * c - moved[..., 0] * s
    size = torch.tensor([source.shape[1], source.shape[0]], dtype=torch.float64, device=device)
    origin = torch.tensor([source.x_min, source.y_min], dtype=torch.float64, device=device)
    cell = ((torch.stack((x, y), -1) - origin) / source.pillar - 0.5) / source.stride
    return ((2 * cell + 1) / size - 1).view(-1, rows, columns, 2)


def masked_max(features: Tensor, seen: Tensor, null: Tensor) -> Tensor:
    """Return (B, C, H, W): maximum of features (B, K, C, H, W) over those of K that see a cell (B, K, H, W); else null (C,)."""
    largest = features.masked_fill(~seen[:, :, None], -torch.inf).amax(1)
    return torch.where(seen.any(1)[:, None], largest, null[:, None, None])
