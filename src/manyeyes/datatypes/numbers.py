# SPDX-License-Identifier: Apache-2.0
"""Numbers as users hold them, to tensors: torch tensors, numpy arrays and nested sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manyeyes.datatypes.errors import ShapeError

Numbers = Tensor | NDArray[Any] | Sequence[Any]


def as_tensor(value: Numbers, name: str, dtype: torch.dtype | None) -> Tensor:
    """Convert numbers to a tensor of that dtype; a tensor keeps its memory where it fits, everything else is copied.

    With None, tensors keep their type, arrays of float32 give float32, and everything else gives float64.

    Raises:
        ShapeError: the value is not a rectangular array of real numbers; ``name`` is the name of the argument.
    """
    if isinstance(value, Tensor):
        return value if dtype is None else value.to(dtype)
    try:
        array = np.array(value)
    except ValueError as error:
        raise ShapeError(f"{name} needs a rectangular array of numbers; got {' '.join(str(error).split())}.") from error
    if array.dtype.kind not in "biuf":
        raise ShapeError(f"{name} needs real numbers; got an array of {array.dtype}: convert it first.")
    if dtype is None:
        dtype = torch.float32 if array.dtype.newbyteorder("=") == np.float32 else torch.float64
    # Through float64, which holds every number type exactly but the largest int64, and any byte order.
    return torch.from_numpy(np.ascontiguousarray(array, np.float64)).to(dtype)
