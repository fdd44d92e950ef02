# SPDX-License-Identifier: Apache-2.0
"""V2X-Reg++: each pair of boxes is a pose hypothesis; the matches are the pairs whose poses bring most other boxes together.

V2I-Calib's overall IoU (oIoU) and V2X-Reg++'s overall distance (oDist) are the two affinities. No prior is needed, and a heading
off by pi is not tried. Landmarks have no class, so the threshold is a car's; the affinity of oIoU counts overlapping boxes.
Without matches there is no estimate, not the identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from manyeyes.ops.box_iou import pairwise_iou
from manyeyes.pose.baselines._common import fit_pose, make_estimate, match_mutual_nearest
from manyeyes.pose.landmarks import Landmarks
from manyeyes.pose.registry import register_pose_corrector
from manyeyes.pose.types import PoseEstimate, PosePrior, no_estimate


@dataclass(frozen=True)
class V2xRegConfig:
    """affinity_kind: oDist or oIoU. max_boxes: the largest so many, within max_range_m. match_distance_m: limit for a car's centre
    and corners. min_affinity: affinity of a match; where the best is at most ``max_weak_affinity``, only the best are taken.
    """

    affinity_kind: Literal["oDist", "oIoU"] = "oDist"
    max_boxes: int = 15
    max_range_m: float = 120.0
    match_distance_m: float = 1.0
    min_affinity: int = 4
    max_weak_affinity: int = 5


@register_pose_corrector("v2x-reg-odist")
def correct(
    ego: Landmarks, other: Landmarks, prior: PosePrior | None, config: V2xRegConfig | None = None
) -> PoseEstimate:
    """Return the pose from the corners of matched boxes; the prior is not used."""
    config = config or V2xRegConfig()
    rows_e, rows_o = _largest(ego, config), _largest(other, config)
    if not len(rows_e) or not len(rows_o):
        return no_estimate(prior)
    a, b = ego[rows_e], other[rows_o]
    affinity = _affinity(a, b, config)
    pairs = np.stack(linear_sum_assignment(-affinity), 1)
    found = affinity[pairs[:, 0], pairs[:, 1]]
    min_affinity = found.max() if found.max() <= config.max_weak_affinity else config.min_affinity
    pairs, weight = pairs[(found >= min_affinity) & (found > 0)], found[(found >= min_affinity) & (found > 0)]
    if not len(pairs):
        return no_estimate(prior)
    corners = [_corners(x)[r].reshape(-1, 2) for x, r in ((a, pairs[:, 0]), (b, pairs[:, 1]))]
    pose = fit_pose(corners[0], corners[1], np.repeat(weight, 4))
    return make_estimate(ego, other, pose, np.stack((rows_e[pairs[:, 0]], rows_o[pairs[:, 1]]), 1), prior)


register_pose_corrector("v2x-reg-oiou")(partial(correct, config=V2xRegConfig("oIoU")))


def _largest(x: Landmarks, config: V2xRegConfig) -> np.ndarray:
    near = np.flatnonzero(np.hypot(*x.xy.T) <= config.max_range_m)
    return near[np.lexsort((*x.xy[near].T, -x.size[near].prod(1)))][: config.max_boxes]


def _affinity(a: Landmarks, b: Landmarks, config: V2xRegConfig) -> np.ndarray:
    """Return (N, M): how many other boxes coincide when box i of a and box j of b are aligned."""
    out = np.zeros((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            yaw = a.yaw[i] - b.yaw[j]
            turned = b.transform(np.array([0.0, 0.0, yaw]))
            moved = b.transform(np.array([*(a.xy[i] - turned.xy[j]), yaw]))
            out[i, j] = (
                _count_overlaps(a, moved)
                if config.affinity_kind == "oIoU"
                else _count_matches(a, moved, config.match_distance_m)
            ) - 1.0
    return out


def _count_matches(a: Landmarks, moved: Landmarks, max_distance_m: float) -> float:
    """Return boxes matched one to one by their centres and by their corners, the mean of both counts."""
    pairs = match_mutual_nearest(a.xy, moved.xy, max_distance_m)
    apart = _corners(a)[pairs[:, 0]] - _corners(moved)[pairs[:, 1]]
    by_corner = np.hypot(apart[..., 0], apart[..., 1]).mean(1) <= max_distance_m
    return (len(pairs) + by_corner.sum()) / 2


def _count_overlaps(a: Landmarks, moved: Landmarks) -> float:
    """Return boxes that overlap, each with its best, one to one."""
    iou = pairwise_iou(*(torch.from_numpy(np.column_stack((x.xy, x.size, x.yaw))) for x in (a, moved))).numpy()
    best = iou.argmax(1)
    mutual = (iou.argmax(0)[best] == np.arange(len(iou))) & (iou.max(1) > 0)
    return float(mutual.sum())


def _corners(x: Landmarks) -> np.ndarray:
    """Return (N, 4, 2): front left, front right, rear right, rear left."""
    local = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]]) * x.size[:, None]
    c, s = np.cos(x.yaw)[:, None], np.sin(x.yaw)[:, None]
    turned = np.stack((c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]), -1)
    return turned + x.xy[:, None]
