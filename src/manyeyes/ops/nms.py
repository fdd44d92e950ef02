# SPDX-License-Identifier: Apache-2.0
"""Greedy non-maximum suppression of oriented boxes on the ground."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from manyeyes.datatypes import ShapeError
from manyeyes.ops.box_iou import aligned_iou, near_pairs


@torch.no_grad()
def rotated_nms(boxes: Tensor, score: Tensor, iou_threshold: float, pre: int = 1000) -> Tensor:
    """Rows (K,) int64 of boxes (N, 5: x, y, length, width, yaw) that survive, in descending score (N,).

    The best `pre` boxes are walked from the highest score, equal scores in the order given; each that still stands
    suppresses those after it whose rotated IoU with it is *greater* than the threshold.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 5 or score.shape != boxes.shape[:1]:
        raise ShapeError(
            f"rotated_nms needs boxes (N, 5) and score (N,); got {tuple(boxes.shape)}, {tuple(score.shape)}."
        )
    order = score.argsort(descending=True, stable=True)[:pre]
    best = boxes[order].double()
    first, second = near_pairs(best, best).triu(1).nonzero(as_tuple=True)
    clash = aligned_iou(best[first], best[second]) > iou_threshold
    after = second[clash].cpu().numpy()
    begin = np.searchsorted(first[clash].cpu().numpy(), np.arange(len(best) + 1))
    standing = np.ones(len(best), dtype=bool)
    for row in range(len(best)):
        if standing[row]:
            standing[after[begin[row] : begin[row + 1]]] = False
    return order[torch.from_numpy(standing).to(order.device)]
