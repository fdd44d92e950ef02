# SPDX-License-Identifier: Apache-2.0
"""Pure functions on tensors; nothing learned."""

from __future__ import annotations

from typing import TYPE_CHECKING

from manyeyes._lazy import attach

if TYPE_CHECKING:
    from manyeyes.ops.box_iou import aligned_iou as aligned_iou, pairwise_iou as pairwise_iou
    from manyeyes.ops.keyed_random import (
        keyed_generator as keyed_generator,
        keyed_normal as keyed_normal,
        keyed_uniform as keyed_uniform,
    )
    from manyeyes.ops.nms import rotated_nms as rotated_nms
    from manyeyes.ops.polyline_distance import (
        chamfer_distance as chamfer_distance,
        frechet_distance as frechet_distance,
    )
    from manyeyes.ops.rigid import fit_rigid as fit_rigid, fit_se2 as fit_se2

__getattr__, __dir__ = attach(__name__)
