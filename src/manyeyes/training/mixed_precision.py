# SPDX-License-Identifier: Apache-2.0
"""Mixed precision: a model whose convolutions and attention layers multiply in bfloat16, while all else stays in float32.

Parameters, their gradients, the optimiser's state, norms, softmax, sums over cells, pillars (whose inputs are metric coordinates),
scores of pruning and selection, weights of fusion, heads and losses are float32. ``torch.autocast`` would also keep the results
of products in bfloat16, so that the sums over cells that follow are taken in it; here a product returns float32. bfloat16 has
the range of float32: gradients need no scaling.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

from torch import Tensor, nn

from manyeyes.datatypes import ConfigError
from manyeyes.models.detector.box_head import BoxHead, RefineHead
from manyeyes.models.detector.layers import SparseConvLayer, UpLayer
from manyeyes.models.detector.transformer import WindowBlock
from manyeyes.models.fusion.flow_aware import PastAttention
from manyeyes.ops.bfloat16_products import bfloat16_linear

Precision = Literal["float32", "bfloat16"]
_HEADS = (BoxHead, RefineHead)


def multiply_in_bfloat16(model: nn.Module) -> int:
    """Let the layers of a model multiply in bfloat16 from now on; returns their number. Names and types of parameters stay.

    Raises:
        ConfigError: the model has neither sparse convolutions nor window attention.
    """
    count = _convert(model)
    if not count:
        raise ConfigError(
            f"precision bfloat16: {type(model).__name__} has no layer that multiplies in it; use float32."
        )
    return count


def _convert(module: nn.Module) -> int:
    if isinstance(module, _HEADS):
        return 0
    if isinstance(module, WindowBlock | PastAttention):
        linears = [part for part in module.modules() if isinstance(part, nn.Linear)]
    else:
        linears = [module.lateral] if isinstance(module, UpLayer) else []
    if isinstance(module, SparseConvLayer):
        module.in_bfloat16 = True
    for linear in linears:
        linear.forward = partial(_multiply, linear)  # pyright: ignore[reportAttributeAccessIssue]
    return len(linears) + isinstance(module, SparseConvLayer) + sum(map(_convert, module.children()))


def _multiply(linear: nn.Linear, x: Tensor) -> Tensor:
    return bfloat16_linear(x, linear.weight, linear.bias)
