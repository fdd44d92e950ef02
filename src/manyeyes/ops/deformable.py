# SPDX-License-Identifier: Apache-2.0
"""Looking up a picture at a few learned places: the product inside deformable attention, from tensor operations alone.

Source: Zhu et al., Deformable DETR, ICLR 2021, Eq. 2. No operator of our own: bilinear sampling is PyTorch's, so it runs, and
has its gradients, on any device, and can be exported.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from manyeyes.datatypes import ShapeError


def sample_weighted(values: Tensor, at: Tensor, weight: Tensor) -> Tensor:
    """Return (B, Q, heads * C): sums of values at places, each head with its own places and weights.

    values: (B, heads, C, rows, columns). at: (B, Q, heads, P, 2), x along columns and y along rows, 0 and 1 being the outer
    borders of the picture; values are bilinear between the centres of cells and zero outside. weight: (B, Q, heads, P).
    """
    b, heads, channels, rows, columns = values.shape
    q, p = at.shape[1], at.shape[3]
    if at.shape != (b, q, heads, p, 2) or weight.shape != at.shape[:-1]:
        raise ShapeError(
            f"sample_weighted needs places (B, Q, heads, P, 2) and weights (B, Q, heads, P) for values (B, heads, C, h, w); "
            f"got {tuple(at.shape)}, {tuple(weight.shape)} and {tuple(values.shape)}."
        )
    places = 2 * at.transpose(1, 2).reshape(b * heads, q, p, 2) - 1
    pictures = values.reshape(b * heads, channels, rows, columns)
    found = F.grid_sample(pictures, places, mode="bilinear", padding_mode="zeros", align_corners=False)
    summed = (found * weight.transpose(1, 2).reshape(b * heads, 1, q, p)).sum(-1)
    return summed.view(b, heads * channels, q).transpose(1, 2)
