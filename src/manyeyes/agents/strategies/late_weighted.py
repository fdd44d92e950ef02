# SPDX-License-Identifier: Apache-2.0
"""Late fusion whose boxes of one object are averaged, weighted by score and covariance, instead of suppressed but for the best.

The groups are those of non-maximum suppression: the best box, and all that it suppresses. The weight of a box is its score over the
variance of its centre: the detector's own, the claimed pose covariance of both agents, at the box's distance, and the motion
since the message. A group keeps the best score, so that detections are ranked as by plain suppression. Sources: Solovyev et al.,
"Weighted boxes fusion", Image and Vision Computing 2021; weights of inverse variance are those of Gauss and Markov.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from manyeyes.agents.strategies.late import LateFusion
from manyeyes.agents.strategies.message_header import age_s
from manyeyes.agents.strategies.registry import register_strategy
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.ops.nms import rotated_nms

MIN_SIGMA_M = 0.1
"""Minimum standard deviation of a centre in a weight, so that no box counts alone."""
SIGMA_VELOCITY_MPS = 1.0
"""Standard deviation of an object's velocity, which makes boxes of older messages less certain."""


@register_strategy("late-weighted")
@dataclass(frozen=True)
class WeightedLateFusion(LateFusion):
    """Exchange of boxes, averaged by score and covariance."""

    def place(self, frame: AgentFrame, message: Message, boxes: Boxes) -> Boxes:
        """Return boxes of a message in the ego's frame; their sigma_xy holds the claimed errors of both poses and of the motion."""
        placed = super().place(frame, message, boxes)
        own, theirs = (a.pose_covariance.diagonal().to(placed.center.dtype).clamp_min(0) for a in (frame, message))
        distance = (boxes.center[:, :2].norm(dim=1), placed.center[:, :2].norm(dim=1))
        turned = theirs[2] * distance[0].square() + own[2] * distance[1].square()
        motion = (SIGMA_VELOCITY_MPS * age_s(frame, message)) ** 2
        variance = placed.sigma_xy.square() + (own[:2] + theirs[:2]).mean() + turned + motion
        return replace(placed, sigma_xy=variance.sqrt())

    def merge(self, boxes: list[Boxes]) -> Boxes:
        """Return one box for each object, by falling score: the weighted mean of its boxes."""
        return merge_boxes_weighted(Boxes.cat(boxes), self.nms_iou)


register_strategy("late-weighted-temporal")(partial(WeightedLateFusion, uses_history=True))


def merge_boxes_weighted(boxes: Boxes, iou: float) -> Boxes:
    """Return the weighted mean of each group of boxes, by falling score; a larger IoU with the best of a group joins it.

    Headings are averaged as offsets from that of the best box, modulo pi; score, class and id are the best box's.
    """
    kept = rotated_nms(boxes.bev().double(), boxes.score, iou, max_candidates=len(boxes))
    if not len(kept):
        return boxes[kept]
    overlaps = pairwise_iou(boxes[kept].bev().double(), boxes.bev().double()) > iou
    overlaps[torch.arange(len(kept)), kept] = True
    # The first of the kept boxes that overlaps suppressed it.
    group = overlaps.to(torch.uint8).argmax(0)
    best = boxes[kept]
    weight = boxes.score / boxes.sigma_xy.clamp_min(MIN_SIGMA_M).square()
    share = weight / weight.new_zeros(len(kept)).index_add(0, group, weight)[group]
    offset = torch.remainder(boxes.yaw - best.yaw[group] + math.pi / 2, math.pi) - math.pi / 2

    def mean(values: Tensor) -> Tensor:
        column = share if values.ndim == 1 else share[:, None]
        return torch.zeros_like(values[: len(kept)]).index_add(0, group, column * values)

    precision = weight.new_zeros(len(kept)).index_add(0, group, 1 / boxes.sigma_xy.clamp_min(MIN_SIGMA_M).square())
    return replace(
        best,
        center=mean(boxes.center),
        size=mean(boxes.size),
        yaw=best.yaw + mean(offset),
        velocity=mean(boxes.velocity),
        sigma_xy=precision.rsqrt(),
    )
