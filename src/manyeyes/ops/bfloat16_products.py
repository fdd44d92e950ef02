# SPDX-License-Identifier: Apache-2.0
"""Products of bfloat16 with float32 results, for mixed precision in training; gradients flow to float32 weights.

Rows and weights are rounded to bfloat16, and sums are float32. A GPU multiplies in bfloat16 and rounds each result to it once. On
the CPU the rounded numbers are multiplied in float32, in the loops that float32 takes anyway.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import linear


def round_to_bfloat16(x: Tensor) -> Tensor:
    """Return float32 values rounded to bfloat16; so is their gradient."""
    return x.to(torch.bfloat16).float()


def bfloat16_linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return x (..., C) times weight (D, C), both rounded to bfloat16, plus bias (D,): float32."""
    if x.device.type == "cpu":
        return linear(round_to_bfloat16(x), round_to_bfloat16(weight), bias)
    product = linear(x.to(torch.bfloat16), weight.to(torch.bfloat16)).float()
    return product if bias is None else product + bias
