# SPDX-License-Identifier: Apache-2.0
"""Protocols of detection metrics by name; :mod:`manyeyes.evaluation.detection.average_precision` defines every rule.

``global-sort`` is ours. The others reproduce the rules of published code; where a source does not say (score thresholds of
``sparsealign`` and ``dair``, NMS of ``dair``), OpenCOOD's value stands in. Their z ranges are those of a LiDAR frame, hence
``z_origin_m``. Their cap of 100 truth boxes a frame is not reproduced.

On OPV2V ``opencood``, ``coalign-opv2v`` (CoAlign) and ``heal-opv2v`` (HEAL): the latter two count a truth box only where it
lies in the range around the LiDAR of an agent that lists it. On DAIR-V2X ``coalign`` (CoAlign), ``heal-dair`` (HEAL),
``sparsealign-dair`` (SparseAlign's rules and its test range), and CoSTr's 102.4 m × 102.4 m, which the paper does not place:
``costr-dair`` ahead of the vehicle, where the original labels are, ``costr-dair-centred`` around it; both by the legacy AP,
which its published numbers suggest. ``dair`` and ``dair-3d`` are the rules of the data set's authors, on the ground and in
space: a box counts with any corner in the range, and cars, vans, trucks and buses are one class, as they are here in all
protocols.

Ties, by the sort that each source uses: the OpenCOOD family (``opencood``, ``coalign*``, ``heal-*``, ``costr-*``,
``sparsealign*``) numpy's default ``argsort``, which is not stable; ``dair*`` Python's ``sorted``, which is, of a list in which
the true positives of a frame stand before its false ones. ``global-sort`` evaluates equal scores together, so that their order
changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from manyeyes.datatypes import VEHICLES, ConfigError

RangeMode = Literal["center_xy", "center", "corners_xy", "corners", "any_corner"]
Range = tuple[float, float, float, float, float, float]
"""x, y, z minimum, then maximum, metres."""


@dataclass(frozen=True)
class DetectionProtocol:
    """How a detection metric is computed; the text of ``average_precision`` defines each field.

    gt_range: x, y, z minimum, then maximum, metres. *_range_mode: box centre, all corners or any corner, in the plane or with
    z. ap_order: which of the two APs is this protocol's own. z_origin_m: height above the road of the origin that the z values
    of gt_range and z_filter are relative to. min_points_in_gt: LiDAR returns of all agents in range that a truth box needs.
    count_frames_without_det: false leaves out the truth of frames without a detection (a known defect). drop_first_segment: the
    sum for AP starts at the first detection's recall (DAIR-V2X). classes: of ``datatypes.CLASSES``; boxes of others are neither
    truth nor detections, and each has metrics of its own. iou_kind: of rectangles on the ground or of boxes in space. ties: how
    equal scores are ordered. agent_range: around the LiDAR of each agent, the part of its list that counts.
    """

    name: str
    ap_order: Literal["global", "concatenated"] = "global"
    score_threshold: float = 0.05
    nms_iou: float = 0.15
    nms_pre: int = 1000
    gt_range: Range = (-140.0, -40.0, -3.0, 140.0, 40.0, 1.0)
    gt_range_mode: RangeMode = "center_xy"
    pred_range_mode: RangeMode = "center_xy"
    drop_large_axis_aligned_m: float | None = None
    z_filter: tuple[float, float] | None = None
    z_origin_m: float = 0.0
    com_range_m: float = 70.0
    min_points_in_gt: int = 0
    count_frames_without_det: bool = True
    matching: Literal["remaining", "best", "truth_first"] = "remaining"
    drop_first_segment: bool = False
    classes: tuple[str, ...] = VEHICLES
    iou_kind: Literal["bev", "3d"] = "bev"
    ties: Literal["together", "numpy", "hits_first"] = "together"
    agent_range: Range | None = None

    def with_range(self, gt_range: Range) -> DetectionProtocol:
        """Return the same rules over another range."""
        return replace(self, gt_range=gt_range)

    def with_classes(self, classes: tuple[str, ...]) -> DetectionProtocol:
        """Return the same rules of other classes."""
        return replace(self, classes=classes)

    @property
    def class_name(self) -> str:
        """The class of a protocol of one class.

        Raises:
            ConfigError: it has several, whose metrics are computed apart.
        """
        if len(self.classes) != 1:
            raise ConfigError(
                f"A detection metric is of one class; protocol {self.name} has {', '.join(self.classes) or 'none'}: "
                "use with_classes."
            )
        return self.classes[0]


_OPENCOOD = DetectionProtocol(
    name="opencood",
    ap_order="concatenated",
    score_threshold=0.20,
    gt_range_mode="corners",
    pred_range_mode="corners_xy",
    drop_large_axis_aligned_m=6.0,
    z_filter=(-3.0, 1.0),
    z_origin_m=1.9,
    ties="numpy",
)

_COALIGN = replace(
    _OPENCOOD,
    name="coalign",
    ap_order="global",
    gt_range=(-100.8, -40.0, -3.5, 100.8, 40.0, 1.5),
    gt_range_mode="corners_xy",
    pred_range_mode="corners",
    com_range_m=100.0,
)

_COALIGN_OPV2V = replace(
    _OPENCOOD,
    name="coalign-opv2v",
    ap_order="global",
    gt_range=(-140.8, -40.0, -3.0, 140.8, 40.0, 1.0),
    agent_range=(-140.8, -40.0, -3.0, 140.8, 40.0, 1.0),
)

_SPARSEALIGN = DetectionProtocol(
    name="sparsealign",
    score_threshold=0.20,
    nms_iou=0.01,
    nms_pre=500,
    gt_range_mode="center",
    pred_range_mode="center",
    z_origin_m=1.9,
    min_points_in_gt=4,
    ties="numpy",
)

_DAIR = DetectionProtocol(
    name="dair",
    score_threshold=0.20,
    gt_range=(0.0, -39.68, -3.0, 100.0, 39.68, 1.0),
    gt_range_mode="any_corner",
    pred_range_mode="any_corner",
    z_origin_m=1.9,
    com_range_m=math.inf,
    matching="truth_first",
    drop_first_segment=True,
    ties="hits_first",
)

_AROUND_HEAL: Range = (-102.4, -102.4, -3.0, 102.4, 102.4, 1.0)

PROTOCOLS: dict[str, DetectionProtocol] = {
    p.name: p
    for p in (
        DetectionProtocol(name="global-sort"),
        _OPENCOOD,
        _COALIGN,
        _SPARSEALIGN,
        _DAIR,
        replace(_DAIR, name="dair-3d", iou_kind="3d"),
        _COALIGN_OPV2V,
        replace(_COALIGN_OPV2V, name="heal-opv2v", gt_range=_AROUND_HEAL, agent_range=_AROUND_HEAL),
        replace(_COALIGN, name="heal-dair", gt_range=(-102.4, -51.2, -3.5, 102.4, 51.2, 1.5)),
        replace(_COALIGN, name="costr-dair", ap_order="concatenated", gt_range=(0.0, -51.2, -3.5, 102.4, 51.2, 1.5)),
        replace(
            _COALIGN, name="costr-dair-centred", ap_order="concatenated", gt_range=(-51.2, -51.2, -3.5, 51.2, 51.2, 1.5)
        ),
        replace(
            _SPARSEALIGN, name="sparsealign-dair", gt_range=(-100.0, -40.0, -3.0, 100.0, 40.0, 1.0), com_range_m=200.0
        ),
    )
}


def get_protocol(name: str) -> DetectionProtocol:
    """Return the protocol of that name."""
    if name not in PROTOCOLS:
        raise ConfigError(f"No evaluation protocol is called {name!r}; known: {', '.join(PROTOCOLS)}.")
    return PROTOCOLS[name]
